# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
#
# make avr        both boards' firmware, build/dongle.elf and build/robot.elf, and their sizes;
#                 RADIO_RATE=0|1|2 (250 kbit/s, 1, 2 Mbit/s) is an option, and RADIO_CHANNEL=0…125,
#                 the channel of a dongle before CFG and of a robot without settings
# make flash PORT=/dev/…, make flash-dongle PORT=/dev/…
#                 flash the robot or the dongle at a serial port; without PORT with the programmer on USB;
#                 DRY_RUN=1 only prints the command
# make release    both programs with their version in the name, SHA256SUMS, and the compiler: build/release;
#                 the same sources, compiler and options give the same bytes
# make simavr     both boards in a simulator with their peripherals, as a library for ctypes

AVR_OBJCOPY ?= avr-objcopy
AVR_BOARD_FLAGS := $(AVR_FLAGS) -DF_CPU=16000000UL -Icore -Ihal -Wl,--gc-sections \
                   $(if $(RADIO_CHANNEL),-DT3_RADIO_CHANNEL=$(RADIO_CHANNEL)) \
                   $(if $(RADIO_RATE),-DT3_RADIO_RATE=$(RADIO_RATE))
# Both programs carry the digest of all sources and settings, reported in INFO and PONG: a change
# of one file rebuilds both.
AVR_SOURCES := $(sort $(wildcard core/*.[ch] hal/*.[ch] avr/*.[ch]))
AVR_ID = $(shell (echo '$(AVR_CC) $(AVR_BOARD_FLAGS)'; cat $(AVR_SOURCES)) | sha256sum | cut -c1-8)

DONGLE_FILES := avr/dongle_main.c hal/reset.c hal/nrf24.c hal/serial.c hal/clock.c \
                $(DONGLE_PARTS:%=core/t3_%.c)
ROBOT_FILES := avr/robot_main.c hal/reset.c hal/nrf24.c hal/stepping.c hal/analog.c hal/imu.c \
               hal/memory.c hal/serial.c $(ROBOT_PARTS:%=core/t3_%.c)

PYTHON ?= python3

.PHONY: simavr flash flash-dongle release

# Everything for the boards depends on it.
$(AVR_SETTINGS): always
	@command -v $(firstword $(AVR_CC)) > /dev/null || { echo 'error: $(AVR_CC) is not installed' >&2; \
	    echo 'remedy: sudo apt-get install gcc-avr avr-libc binutils-avr' >&2; exit 127; }
	@$(call keep,avr.settings,$(AVR_CC) $(AVR_BOARD_FLAGS) $(ROBOT_MCU) $(DONGLE_MCU))

avr: $(BUILD)/dongle.elf $(BUILD)/robot.elf $(BUILD)/dongle.hex $(BUILD)/robot.hex
	@echo 'build $(AVR_ID)'
	$(AVR_SIZE) $(BUILD)/dongle.elf $(BUILD)/robot.elf

$(BUILD)/dongle.elf: $(AVR_SOURCES) $(AVR_SETTINGS)
	@mkdir -p $(BUILD)
	$(AVR_CC) -mmcu=$(DONGLE_MCU) $(AVR_BOARD_FLAGS) -DT3_BUILD=0x$(AVR_ID) -o $@ $(DONGLE_FILES)

$(BUILD)/robot.elf: $(AVR_SOURCES) $(AVR_SETTINGS)
	@mkdir -p $(BUILD)
	$(AVR_CC) -mmcu=$(ROBOT_MCU) $(AVR_BOARD_FLAGS) -DT3_BUILD=0x$(AVR_ID) -o $@ $(ROBOT_FILES)

$(BUILD)/%.hex: $(BUILD)/%.elf
	$(AVR_OBJCOPY) -O ihex -R .eeprom $< $@

flash: $(BUILD)/robot.hex
	$(PYTHON) flash.py robot $< $(if $(PORT),--port $(PORT)) $(if $(DRY_RUN),--dry-run) $(FLASH)

flash-dongle: $(BUILD)/dongle.hex
	$(PYTHON) flash.py dongle $< $(if $(PORT),--port $(PORT)) $(if $(DRY_RUN),--dry-run) $(FLASH)

VERSION = $(shell sed -n 's/.define T3_FIRMWARE_M[AI][JN]OR \([0-9]*\)u/\1/p' core/t3_protocol.h | paste -sd.)
RELEASE := $(BUILD)/release

release: $(BUILD)/robot.hex $(BUILD)/dongle.hex
	@rm -rf $(RELEASE) && mkdir -p $(RELEASE)
	@for board in robot dongle; do cp $(BUILD)/$$board.hex $(RELEASE)/$$board-$(VERSION).hex; done
	@$(AVR_CC) --version | head -n 1 > $(RELEASE)/COMPILER
	@cd $(RELEASE) && sha256sum *.hex > SHA256SUMS && cat COMPILER SHA256SUMS

SIMAVR_FILES := $(sort $(wildcard simavr/*.c))

simavr: $(BUILD)/libt3simavr.so

$(BUILD)/libt3simavr.so: $(SIMAVR_FILES) $(wildcard simavr/*.h)
	@mkdir -p $(BUILD)
	$(CC) -std=gnu11 -O2 -Wall -Wextra -Werror -fPIC -shared -isystem /usr/include/simavr -o $@ \
	    $(SIMAVR_FILES) -lsimavr -lelf
