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

// The portable core on a host: a robot and a dongle with simulated hardware, in virtual time,
// behind functions that ctypes can call without the layout of a structure.
#ifndef T3_HOST_H
#define T3_HOST_H

#include <stdbool.h>
#include <stdint.h>

// -- robot ---------------------------------------------------------------------------------------

struct t3_host_robot;

// Not booted; its EEPROM holds the default settings and no key.
struct t3_host_robot *t3_host_robot_new(void);
void t3_host_robot_free(struct t3_host_robot *host);
// Key (16 bytes; NULL: none) as if written over USB; holds from the next boot on.
void t3_host_robot_store_key(struct t3_host_robot *host, const uint8_t *key);
// Settings as if written over USB; they hold from the next boot on.
void t3_host_robot_store_settings(struct t3_host_robot *host, uint8_t channel,
                                  uint16_t microsteps, const uint8_t *address);
// Bit rate in the stored settings, as in CFG.
void t3_host_robot_store_rate(struct t3_host_robot *host, uint8_t rate);
// Erase the whole EEPROM, as in a new chip.
void t3_host_robot_erase(struct t3_host_robot *host);
// Reset: EEPROM and the pulses counted outside stay, the clock of the board starts at `time_us`.
void t3_host_robot_boot(struct t3_host_robot *host, uint8_t reset_cause, uint32_t time_us);
// A payload comes out of the radio now. Return whether it is a CMD that sets the wheel speeds.
bool t3_host_robot_packet(struct t3_host_robot *host, const uint8_t *data, uint8_t size);
// Let time pass: the stepping interrupt every 50 us, the main loop every `T3_HOST_LOOP_US`.
void t3_host_robot_run(struct t3_host_robot *host, uint32_t us);
#define T3_HOST_LOOP_US 200u

// What the surroundings of a robot see of it.
struct t3_host_motion {
    // Microsteps issued during the call, signed by DIR; the phase of the pulse generator gives the
    // fractions, so that a motor turns evenly between two pulses.
    double left, right;
    uint32_t loads;     // payloads loaded so far
    uint32_t setups;    // records written so far
    uint32_t usb_size;  // bytes to take from the USB console
    bool powered;       // drivers
    bool turning;       // pulses are being issued
};

// Let at most `us` pass, but no more once the power of the drivers or the rate of the pulses has
// changed; return how many.
uint32_t t3_host_robot_advance(struct t3_host_robot *host, uint32_t us,
                               struct t3_host_motion *motion);
// Let time pass with the stepping interrupt alone: the main loop hangs.
void t3_host_robot_stall(struct t3_host_robot *host, uint32_t us);
// Shift the clock of the board and all its time stamps: for tests of the wraps.
void t3_host_robot_poke_time(struct t3_host_robot *host, uint32_t time_us);
uint32_t t3_host_robot_time(const struct t3_host_robot *host);
// The payload an exchange would fetch now (32 bytes of room); its size, 0 before the first.
uint8_t t3_host_robot_ack(const struct t3_host_robot *host, uint8_t *to);
uint32_t t3_host_robot_loads(const struct t3_host_robot *host);  // how many were loaded
uint8_t t3_host_robot_status(const struct t3_host_robot *host);
uint8_t t3_host_robot_session(const struct t3_host_robot *host);
uint16_t t3_host_robot_stale(const struct t3_host_robot *host);  // the counter of AUX
// Settings in effect.
uint16_t t3_host_robot_microsteps(const struct t3_host_robot *host);
uint8_t t3_host_robot_rate(const struct t3_host_robot *host);
uint8_t t3_host_robot_channel(const struct t3_host_robot *host);
void t3_host_robot_address(const struct t3_host_robot *host, uint8_t *five);
// What the hardware does.
bool t3_host_robot_powered(const struct t3_host_robot *host);
int32_t t3_host_robot_pulses(const struct t3_host_robot *host, uint8_t wheel);  // signed by DIR
int32_t t3_host_robot_steps(const struct t3_host_robot *host, uint8_t wheel);  // the counter
void t3_host_robot_poke_steps(struct t3_host_robot *host, uint8_t wheel, int32_t count);
int32_t t3_host_robot_speed(const struct t3_host_robot *host, uint8_t wheel);  // urad/s, ramped
uint32_t t3_host_robot_closest_pulses(const struct t3_host_robot *host);  // us; all ones: none
uint32_t t3_host_robot_unpowered_pulses(const struct t3_host_robot *host);
uint32_t t3_host_robot_hasty_pulses(const struct t3_host_robot *host);  // DIR changed with STEP
uint32_t t3_host_robot_eeprom_writes(const struct t3_host_robot *host);
void t3_host_robot_poke_eeprom(struct t3_host_robot *host, uint16_t address, uint8_t value);
// What a reset finds: a write changes the cells one by one, each takes so long (0: no time).
uint8_t t3_host_robot_cell(const struct t3_host_robot *host, uint16_t address);
void t3_host_robot_set_cell_us(struct t3_host_robot *host, uint32_t us);
void t3_host_robot_wear(struct t3_host_robot *host, uint16_t address, bool worn);
// USB console: feed bytes; take its output (at most `room`).
void t3_host_robot_usb(struct t3_host_robot *host, const uint8_t *data, uint32_t size);
uint32_t t3_host_robot_usb_take(struct t3_host_robot *host, uint8_t *to, uint32_t room);
// Whether a key or record of a frame is being written, or a transaction is to be answered.
bool t3_host_robot_changing(const struct t3_host_robot *host);
bool t3_host_robot_writing(const struct t3_host_robot *host);  // the same, or a copy is repaired
void t3_host_robot_usb_overrun(struct t3_host_robot *host);
uint8_t t3_host_robot_levels(const struct t3_host_robot *host);  // T3_SIGNAL_*
void t3_host_robot_set_chip(struct t3_host_robot *host, bool ok);
// What the hardware gives.
void t3_host_robot_press(struct t3_host_robot *host, bool pressed);
void t3_host_robot_set_imu(struct t3_host_robot *host, bool answers, const int16_t *seven);
void t3_host_robot_set_adc(struct t3_host_robot *host, uint8_t channel, uint16_t count);
// Where the sample of the IMU (seven numbers) and the counts (nine) lie, to be written there.
int16_t *t3_host_robot_imu(struct t3_host_robot *host);
uint16_t *t3_host_robot_adcs(struct t3_host_robot *host);
// Start of the noise, from the next boot on.
void t3_host_robot_set_noise(struct t3_host_robot *host, uint32_t noise);
// The next nonce the robot draws is this one: for vectors only.
void t3_host_robot_force_nonce(struct t3_host_robot *host, const uint8_t *nonce);

// -- dongle --------------------------------------------------------------------------------------

struct t3_host_dongle;

struct t3_host_dongle *t3_host_dongle_new(uint8_t reset_cause);
void t3_host_dongle_free(struct t3_host_dongle *host);
void t3_host_dongle_bytes(struct t3_host_dongle *host, const uint8_t *data, uint32_t size);
void t3_host_dongle_run(struct t3_host_dongle *host, uint32_t us);
// Reset; its clock starts at zero.
void t3_host_dongle_boot(struct t3_host_dongle *host, uint8_t reset_cause);
// Set the clock and let the main loop come round once.
void t3_host_dongle_tick(struct t3_host_dongle *host, uint32_t time_us);
// Time (us) until the main loop has work to do; all ones: only bytes or the radio bring some.
uint32_t t3_host_dongle_idle_us(const struct t3_host_dongle *host);
// Configuration of the radio chip: channel, rate, power, retry delay, retries, address.
void t3_host_dongle_radio(const struct t3_host_dongle *host, uint8_t *ten);
// Take what it wrote to USB: how many bytes (at most `room`).
uint32_t t3_host_dongle_take(struct t3_host_dongle *host, uint8_t *to, uint32_t room);
// Take what it sent by radio since the last call: its size, 0 if nothing.
uint8_t t3_host_dongle_sent(struct t3_host_dongle *host, uint8_t *to);
void t3_host_dongle_answer(struct t3_host_dongle *host, bool acknowledged, uint8_t retransmits,
                           const uint8_t *answer, uint8_t size);
void t3_host_dongle_set_chip(struct t3_host_dongle *host, bool ok);
void t3_host_dongle_overrun(struct t3_host_dongle *host);
uint32_t t3_host_dongle_time(const struct t3_host_dongle *host);
uint32_t t3_host_dongle_configured(const struct t3_host_dongle *host);  // how often

// -- pieces --------------------------------------------------------------------------------------

uint16_t t3_host_crc16(const uint8_t *data, uint8_t size);
uint8_t t3_host_to_wire(const uint8_t *frame, uint8_t size, uint8_t *wire);
void t3_host_siphash(const uint8_t *key, const uint8_t *data, uint8_t size, uint8_t *out);
uint8_t t3_host_range_code(uint16_t count);
uint32_t t3_host_time_us(uint32_t last_tick_us, uint8_t timer_us, bool tick_waits);
// One of enum t3_refusal; numbers: kind, session, seq, what, ttl, left, right, value, echo_us,
// host_us, 1 for a nonce, 1 for a tag.
uint8_t t3_host_decode(const uint8_t *data, uint8_t size, int64_t *twelve);
// Encode an uplink payload from its fields in the order of the wire, bytes one number each; its
// size, 0 for an unknown kind.
uint8_t t3_host_encode(uint8_t kind, const int64_t *fields, bool with_nonce, uint8_t *to);

struct t3_host_splitter;

struct t3_host_splitter *t3_host_splitter_new(void);
void t3_host_splitter_free(struct t3_host_splitter *host);
// Take bytes up to the end of the first good frame: how many were taken; `size` is the frame's, 0
// if there was none, its bytes are in `frame` (78 of room).
uint32_t t3_host_splitter_feed(struct t3_host_splitter *host, const uint8_t *data, uint32_t count,
                               uint8_t *frame, uint8_t *size);
void t3_host_splitter_counts(const struct t3_host_splitter *host, uint16_t *three);

#endif
