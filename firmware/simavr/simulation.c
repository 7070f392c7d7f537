// Copyright 2026 The t3mpc_ros developers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.
#include "simulation.h"

#include <avr_eeprom.h>
#include <avr_ioport.h>
#include <stdlib.h>
#include <string.h>

#include "board_model.h"

enum { DONGLE, ROBOT, BOARDS };

static const struct board_layout LAYOUTS[BOARDS] = {
    {"atmega328p", {'B', 2}, {'B', 1}, {'D', 2}},
    {"atmega2560", {'B', 0}, {'B', 4}, {'E', 4}},
};
static const struct pin STEP[] = {{'A', 0}, {'A', 1}}, BACK[] = {{'A', 2}, {'A', 3}};
static const struct pin ESTOP = {'E', 5};
#define PORT_A_DIRECTION 0x21u  // data addresses of the ATmega2560
#define PORT_A 0x22u
#define DRIVERS_OFF 0x10u

struct wheel {
    const struct simulation *sim;
    bool step, back;
    int64_t pulses, unpowered, hasty;
    uint64_t high_at, low_at, back_at;
    int64_t shortest_high, shortest_low, shortest_setup;
};

struct simulation {
    struct board boards[BOARDS];
    struct radio_channel channel;
    uint64_t now;
    struct wheel wheels[2];
    bool pressed;
};

static const avr_t *robot_of(const struct simulation *sim)
{
    return sim->boards[ROBOT].avr;
}

bool t3_sim_powered(const struct simulation *sim)
{
    // A pull-up holds the drivers off while the pin floats.
    const uint8_t *data = robot_of(sim)->data;
    return data[PORT_A_DIRECTION] & DRIVERS_OFF && !(data[PORT_A] & DRIVERS_OFF);
}

// -- drivers -------------------------------------------------------------------------------------

static void shorten(int64_t *shortest, uint64_t since, uint64_t now)
{
    if (since && (int64_t)(now - since) < *shortest)
        *shortest = (int64_t)(now - since);
}

static void back_changed(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    struct wheel *wheel = param;
    wheel->back = value & 1;
    wheel->back_at = robot_of(wheel->sim)->cycle;
}

static void step_changed(avr_irq_t *irq, uint32_t value, void *param)
{
    struct wheel *wheel = param;
    const struct simulation *sim = wheel->sim;
    const uint64_t now = robot_of(sim)->cycle;
    (void)irq;
    if ((value & 1) == wheel->step)
        return;
    wheel->step = value & 1;
    if (!wheel->step) {
        shorten(&wheel->shortest_high, wheel->high_at, now);
        wheel->low_at = now;
        return;
    }
    shorten(&wheel->shortest_low, wheel->low_at, now);
    shorten(&wheel->shortest_setup, wheel->back_at, now);
    wheel->high_at = now;
    // The register already has what this pin's neighbour will show in a moment.
    const uint8_t mask = wheel == sim->wheels ? 0x04 : 0x08;
    const bool back = robot_of(sim)->data[PORT_A] & mask;
    wheel->hasty += back != wheel->back;
    if (t3_sim_powered(sim))
        wheel->pulses += back ? -1 : 1;
    else
        wheel->unpowered++;
}

// -- together ------------------------------------------------------------------------------------

static void show_button(struct simulation *sim)
{
    // The contact is stronger than the pin's pull-up, which simavr would show else.
    avr_ioport_external_t external = {.name = ESTOP.port, .mask = 1u << ESTOP.bit};
    external.value = sim->pressed ? 1u << ESTOP.bit : 0;
    avr_ioctl(sim->boards[ROBOT].avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(ESTOP.port), &external);
    board_show(&sim->boards[ROBOT], ESTOP, sim->pressed);
}

static void restored(struct board *board)
{
    // The robot's board is the second member of the array that begins the simulation.
    struct simulation *sim = (struct simulation *)(board - ROBOT);
    board_show(board, ESTOP, !sim->pressed);
    show_button(sim);
}

struct simulation *t3_sim_new(const char *dongle_elf, const char *robot_elf, uint64_t seed)
{
    struct simulation *sim = calloc(1, sizeof *sim);
    const char *elfs[BOARDS] = {dongle_elf, robot_elf};
    if (!sim)
        return NULL;
    sim->channel.random = seed * 2 + 1;
    for (int i = 0; i < BOARDS; i++) {
        sim->channel.radios[i] = &sim->boards[i].radio;
        if (!board_open(&sim->boards[i], &LAYOUTS[i], elfs[i])) {
            t3_sim_free(sim);
            return NULL;
        }
    }
    board_attach_uart(&sim->boards[DONGLE]);
    board_attach_uart(&sim->boards[ROBOT]);
    board_attach_twi(&sim->boards[ROBOT]);
    sim->boards[ROBOT].restored = restored;
    sim->boards[ROBOT].imu.present = true;
    for (int i = 0; i < 2; i++) {
        struct wheel *wheel = &sim->wheels[i];
        wheel->sim = sim;
        wheel->shortest_high = wheel->shortest_low = wheel->shortest_setup = INT64_MAX;
        avr_irq_register_notify(board_pin(&sim->boards[ROBOT], STEP[i]), step_changed, wheel);
        avr_irq_register_notify(board_pin(&sim->boards[ROBOT], BACK[i]), back_changed, wheel);
    }
    return sim;
}

void t3_sim_free(struct simulation *sim)
{
    for (int i = 0; i < BOARDS; i++)
        board_close(&sim->boards[i]);
    free(sim);
}

static void step(struct simulation *sim, uint64_t until)
{
    for (int i = 0; i < BOARDS; i++) {
        board_run_uart(&sim->boards[i], sim->now);
        board_run(&sim->boards[i], until);
    }
    radio_channel_run(&sim->channel, until);
    sim->now = until;
}

void t3_sim_run(struct simulation *sim, uint32_t us)
{
    const uint64_t end = sim->now + (uint64_t)us * CYCLES_PER_US;
    while (sim->now < end) {
        const uint64_t next = sim->now + LOCK_STEP_CYCLES;
        step(sim, next < end ? next : end);
    }
}

bool t3_sim_run_to_byte(struct simulation *sim, uint32_t us)
{
    const uint64_t end = sim->now + (uint64_t)us * CYCLES_PER_US;
    const struct line *out = &sim->boards[DONGLE].serial.out;
    while (sim->now < end) {
        if (out->tail != out->head && out->at[out->tail % LINE_ROOM] <= sim->now)
            return true;
        const uint64_t next = sim->now + LOCK_STEP_CYCLES;
        step(sim, next < end ? next : end);
    }
    return false;
}

uint64_t t3_sim_cycles(const struct simulation *sim)
{
    return sim->now;
}

// -- serial line ---------------------------------------------------------------------------------

static void put(const struct simulation *sim, struct line *in, const uint8_t *data, uint32_t size)
{
    uint64_t at = sim->now;
    if (in->head != in->tail && in->at[(in->head - 1) % LINE_ROOM] > at)
        at = in->at[(in->head - 1) % LINE_ROOM];
    for (; size && in->head - in->tail < LINE_ROOM; size--) {
        at += BYTE_CYCLES;
        in->bytes[in->head % LINE_ROOM] = *data++;
        in->at[in->head++ % LINE_ROOM] = at;
    }
}

static uint32_t take(const struct simulation *sim, struct line *out, uint8_t *data, uint64_t *at,
                     uint32_t room)
{
    uint32_t count = 0;
    for (; count < room && out->tail != out->head; count++) {
        const uint32_t i = out->tail % LINE_ROOM;
        if (out->at[i] > sim->now)
            break;
        data[count] = out->bytes[i];
        at[count] = out->at[i];
        out->tail++;
    }
    return count;
}

void t3_sim_write(struct simulation *sim, const uint8_t *data, uint32_t size)
{
    put(sim, &sim->boards[DONGLE].serial.in, data, size);
}

uint32_t t3_sim_read(struct simulation *sim, uint8_t *data, uint64_t *at, uint32_t room)
{
    return take(sim, &sim->boards[DONGLE].serial.out, data, at, room);
}

void t3_sim_usb_write(struct simulation *sim, const uint8_t *data, uint32_t size)
{
    put(sim, &sim->boards[ROBOT].serial.in, data, size);
}

uint32_t t3_sim_usb_read(struct simulation *sim, uint8_t *data, uint64_t *at, uint32_t room)
{
    return take(sim, &sim->boards[ROBOT].serial.out, data, at, room);
}

uint32_t t3_sim_usb_overruns(const struct simulation *sim)
{
    return sim->boards[ROBOT].serial.overruns;
}

uint32_t t3_sim_overruns(const struct simulation *sim)
{
    return sim->boards[DONGLE].serial.overruns;
}

// -- air -----------------------------------------------------------------------------------------

void t3_sim_loss(struct simulation *sim, double down, double up)
{
    sim->channel.loss[0] = down;
    sim->channel.loss[1] = up;
}

void t3_sim_jam(struct simulation *sim, bool jammed)
{
    sim->channel.jammed = jammed;
}

void t3_sim_radio_power(struct simulation *sim, int board, bool on)
{
    nrf24_power(&sim->boards[board].radio, on, sim->now);
}

bool t3_sim_inject(struct simulation *sim, const uint8_t *data, uint8_t size, uint8_t width)
{
    return nrf24_inject(&sim->boards[ROBOT].radio, data, size, width);
}

void t3_sim_deafen(struct simulation *sim, const uint8_t *data, uint8_t size)
{
    nrf24_deafen(&sim->boards[ROBOT].radio, data, size);
}

void t3_sim_answer(struct simulation *sim, const uint8_t *data, uint8_t size)
{
    struct nrf24_fifo *waiting = &sim->boards[ROBOT].radio.tx;
    waiting->count = 1;
    waiting->packets[0].width = size;
    memcpy(waiting->packets[0].data, data, size);
}

uint8_t t3_sim_last_packet(const struct simulation *sim, uint8_t *data)
{
    const struct nrf24 *radio = &sim->boards[ROBOT].radio;
    memcpy(data, radio->last_packet.data, radio->last_packet.width);
    return radio->last_packet.width;
}

uint8_t t3_sim_radio_register(const struct simulation *sim, int board, uint8_t which)
{
    return sim->boards[board].radio.registers[which & 0x1F];
}

uint8_t t3_sim_waiting_acks(const struct simulation *sim)
{
    return sim->boards[ROBOT].radio.tx.count;
}

void t3_sim_radio_counts(const struct simulation *sim, int board, uint32_t *eleven)
{
    const struct nrf24 *radio = &sim->boards[board].radio;
    const uint32_t counts[] = {radio->sent, radio->received, radio->duplicates, radio->attempts};
    memcpy(eleven, counts, sizeof counts);
    memcpy(eleven + 4, &radio->faults, sizeof radio->faults);
}

// -- boards --------------------------------------------------------------------------------------

void t3_sim_reset(struct simulation *sim, int board)
{
    board_reset(&sim->boards[board]);
}

uint32_t t3_sim_resets(const struct simulation *sim, int board)
{
    return sim->boards[board].resets;
}

uint64_t t3_sim_busy_cycles(const struct simulation *sim, int board)
{
    return sim->boards[board].avr->cycle - sim->boards[board].slept;
}

uint8_t t3_sim_peek(const struct simulation *sim, int board, uint16_t address)
{
    return sim->boards[board].avr->data[address];
}

void t3_sim_poke(struct simulation *sim, int board, uint16_t address, uint8_t value)
{
    sim->boards[board].avr->data[address] = value;
}

void t3_sim_eeprom(struct simulation *sim, uint16_t address, uint8_t *data, uint16_t size,
                   bool write)
{
    avr_eeprom_desc_t where = {.ee = data, .offset = address, .size = size};
    avr_ioctl(sim->boards[ROBOT].avr, write ? AVR_IOCTL_EEPROM_SET : AVR_IOCTL_EEPROM_GET, &where);
}

// -- surroundings --------------------------------------------------------------------------------

void t3_sim_press(struct simulation *sim, bool pressed)
{
    sim->pressed = pressed;
    show_button(sim);
}

void t3_sim_imu(struct simulation *sim, bool present, const int16_t *seven)
{
    struct imu_model *imu = &sim->boards[ROBOT].imu;
    if (present && !imu->present) {
        memset(imu, 0, sizeof *imu);
        imu->registers[0x6B] = 0x40;
    }
    imu->present = present;
    for (int i = 0; i < 7; i++) {
        imu->registers[0x3B + 2 * i] = (uint8_t)((uint16_t)seven[i] >> 8);
        imu->registers[0x3C + 2 * i] = (uint8_t)seven[i];
    }
}

void t3_sim_imu_reset(struct simulation *sim)
{
    static const uint8_t CONFIGURED[] = {0x19, 0x1A, 0x1B, 0x1C};
    struct imu_model *imu = &sim->boards[ROBOT].imu;
    for (size_t i = 0; i < sizeof CONFIGURED; i++)
        imu->registers[CONFIGURED[i]] = 0;
    imu->registers[0x6B] = 0x40;
}

uint8_t t3_sim_imu_register(const struct simulation *sim, uint8_t which)
{
    return sim->boards[ROBOT].imu.registers[which & 0x7F];
}

void t3_sim_millivolts(struct simulation *sim, uint8_t channel, uint16_t millivolts)
{
    // By hand: simavr's own inputs end at channel 7.
    if (channel < 16)
        sim->boards[ROBOT].adc->adc_values[channel] = millivolts;
}

void t3_sim_wheel(const struct simulation *sim, int wheel, int64_t *six)
{
    const struct wheel *it = &sim->wheels[wheel];
    const int64_t numbers[] = {it->pulses,        it->unpowered,    it->hasty,
                               it->shortest_high, it->shortest_low, it->shortest_setup};
    memcpy(six, numbers, sizeof numbers);
}
