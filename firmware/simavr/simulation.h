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

// A dongle and a robot, each its own program on its own simulated AVR, in virtual time: functions
// that ctypes can call without knowing a single structure. Boards are 0 (dongle) and 1 (robot).
#ifndef SIMULATION_H
#define SIMULATION_H

#include <stdbool.h>
#include <stdint.h>

struct simulation;

struct simulation *t3_sim_new(const char *dongle_elf, const char *robot_elf, uint64_t seed);
void t3_sim_free(struct simulation *sim);
void t3_sim_run(struct simulation *sim, uint32_t us);
// Run until the dongle has sent a byte, or until the limit; return whether it has sent one.
bool t3_sim_run_to_byte(struct simulation *sim, uint32_t us);
uint64_t t3_sim_cycles(const struct simulation *sim);  // 16 to a microsecond

// Serial line at 500000 baud both ways. `at` is the time of the last bit of a byte.
void t3_sim_write(struct simulation *sim, const uint8_t *data, uint32_t size);
uint32_t t3_sim_read(struct simulation *sim, uint8_t *data, uint64_t *at, uint32_t room);
uint32_t t3_sim_overruns(const struct simulation *sim);
// The same for the robot's own USB.
void t3_sim_usb_write(struct simulation *sim, const uint8_t *data, uint32_t size);
uint32_t t3_sim_usb_read(struct simulation *sim, uint8_t *data, uint64_t *at, uint32_t room);
uint32_t t3_sim_usb_overruns(const struct simulation *sim);

// Air.
void t3_sim_loss(struct simulation *sim, double down, double up);
void t3_sim_jam(struct simulation *sim, bool jammed);
void t3_sim_radio_power(struct simulation *sim, int board, bool on);
bool t3_sim_inject(struct simulation *sim, const uint8_t *data, uint8_t size, uint8_t width);
// Fill the RX FIFO of the robot's radio with copies of a payload while its RX_DR flag is clear.
void t3_sim_deafen(struct simulation *sim, const uint8_t *data, uint8_t size);
// Let this be what the robot's radio answers next, whatever its firmware has loaded.
void t3_sim_answer(struct simulation *sim, const uint8_t *data, uint8_t size);
// The last packet that the radio of the robot received; its width, 0 if there is none.
uint8_t t3_sim_last_packet(const struct simulation *sim, uint8_t *data);
uint8_t t3_sim_radio_register(const struct simulation *sim, int board, uint8_t which);
uint8_t t3_sim_waiting_acks(const struct simulation *sim);
// sent, received, duplicates, attempts, then what struct nrf24_faults counts, in its order.
void t3_sim_radio_counts(const struct simulation *sim, int board, uint32_t *eleven);

// Boards.
void t3_sim_reset(struct simulation *sim, int board);
uint32_t t3_sim_resets(const struct simulation *sim, int board);
uint64_t t3_sim_busy_cycles(const struct simulation *sim, int board);
uint8_t t3_sim_peek(const struct simulation *sim, int board, uint16_t address);
void t3_sim_poke(struct simulation *sim, int board, uint16_t address, uint8_t value);
void t3_sim_eeprom(struct simulation *sim, uint16_t address, uint8_t *data, uint16_t size,
                   bool write);

// The robot's surroundings.
void t3_sim_press(struct simulation *sim, bool pressed);
void t3_sim_imu(struct simulation *sim, bool present, const int16_t *seven);
// The MPU6050 resets itself: it sleeps with the registers of its power-on.
void t3_sim_imu_reset(struct simulation *sim);
uint8_t t3_sim_imu_register(const struct simulation *sim, uint8_t which);
void t3_sim_millivolts(struct simulation *sim, uint8_t channel, uint16_t millivolts);
bool t3_sim_powered(const struct simulation *sim);
// Per wheel: pulses by DIR, pulses while without power, pulses with DIR changed at the same time,
// shortest time high, shortest time low, shortest time from DIR to STEP (cycles).
void t3_sim_wheel(const struct simulation *sim, int wheel, int64_t *six);

#endif
