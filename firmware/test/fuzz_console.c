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

// Well-framed nonsense, damaged keys, packets and resets at once: the key is only ever what a whole
// KEY frame requested, completely or not at all; during a write no session is accepted.

#include <stdbool.h>
#include <stdio.h>
#include <string.h>

#include "fuzz.h"
#include "t3_bytes.h"
#include "t3_console.h"
#include "t3_host.h"
#include "t3_siphash.h"
#include "t3_store.h"

#define FRAMES 100000ul
#define CELL_US 3400u

static uint8_t wanted[T3_KEY_SIZE];  // by the last KEY frame that was sent undamaged
static uint8_t written, refused, damaged_starts, set;

static uint32_t check_of(const uint8_t *key)
{
    uint8_t hash[8];
    t3_siphash(key, (const uint8_t *)"\4t3mpc", 6, hash);  // 4: the use as a check value
    return t3_get32(hash);
}

// Return the next of the frames that stage and store settings, mostly valid ones.
static uint8_t make_setup(uint8_t *frame)
{
    static uint8_t body[2 * T3_PART_SIZE], step;
    frame[2] = T3_RECORD_SETTINGS;
    if (step == 0) {
        struct t3_setup setup = T3_SETUP_DEFAULTS;
        setup.channel = (uint8_t)fuzz_below(130);
        setup.microsteps = (uint16_t)(1u << fuzz_below(10));
        t3_setup_encode(&setup, body);
    }
    if (step < 2) {
        frame[0] = T3_RECORD;
        frame[3] = step;
        memcpy(frame + 4, body + step * T3_PART_SIZE, T3_PART_SIZE);
        step++;
        return 20;
    }
    step = 0;
    frame[0] = T3_STORE;
    t3_put16(frame + 3, t3_crc16(body, T3_SETUP_BODY));
    return 5;
}

static uint8_t make_frame(uint8_t *frame)
{
    const uint8_t size = (uint8_t)(1 + fuzz_below(T3_FRAME_LIMIT));
    for (uint8_t i = 0; i < size; i++)
        frame[i] = fuzz_byte();
    switch (fuzz_below(8)) {
    case 0:
        frame[0] = T3_PING;
        return fuzz_below(4) ? (uint8_t)T3_PING_SIZE : size;
    case 1:
    case 2:
        frame[0] = T3_KEY;
        return 2;
    case 3:
        frame[0] = T3_KEY;
        if (fuzz_below(4) == 0)
            memset(frame + 2, 0, T3_KEY_SIZE);
        return 18;
    case 4:
        frame[0] = T3_KEY;
        return size;
    case 5:
        return make_setup(frame);
    case 6:
        frame[0] = (uint8_t)(T3_RECORD + fuzz_below(3));
        frame[2] = (uint8_t)fuzz_below(3);
        frame[3] = (uint8_t)fuzz_below(8);
        if (frame[0] == T3_RECORD)
            return fuzz_below(2) ? 20 : 4;
        return fuzz_below(4) ? (frame[0] == T3_STORE ? 5 : 2) : size;
    default:
        return size;
    }
}

#define HEADER (T3_VERSION << 4)

static void drive(struct t3_host_robot *robot, uint8_t session)
{
    uint8_t data[T3_RADIO_LIMIT] = {0};
    data[1] = session;
    data[2] = fuzz_byte();
    data[0] = (uint8_t)(HEADER | (fuzz_below(3) ? T3_CMD : T3_HELLO));
    if (data[0] == (HEADER | T3_HELLO)) {
        t3_host_robot_packet(robot, data, 4);
        return;
    }
    data[3] = fuzz_below(3) ? T3_FLAG_ENABLE : 0;
    data[4] = 20;
    t3_put16(data + 6, (uint16_t)fuzz_below(5000));
    t3_put32(data + 10, t3_host_robot_time(robot));
    t3_host_robot_packet(robot, data, T3_CMD_SIZE);
}

// After a reset the record is the old key, the new key, or an invalid record.
static void check_cells(struct t3_host_robot *robot, const uint8_t *before)
{
    uint8_t record[T3_KEY_SIZE + T3_CRC_SIZE];
    bool blank = true;
    for (uint8_t i = 0; i < sizeof record; i++) {
        record[i] = t3_host_robot_cell(robot, (uint8_t)(T3_STORE_KEY + i));
        blank = blank && record[i] == 0xFF;
    }
    if (t3_host_robot_cell(robot, T3_STORE_KEY_MARK) != 0xFF)
        return;
    if (blank || t3_crc16(record, T3_KEY_SIZE) != t3_get16(record + T3_KEY_SIZE))
        return;
    CHECK(!memcmp(record, wanted, T3_KEY_SIZE) || !memcmp(record, before, T3_KEY_SIZE));
}

static void read_console(struct t3_host_robot *robot, struct t3_splitter *splitter)
{
    uint8_t out[4096];
    const uint32_t size = t3_host_robot_usb_take(robot, out, sizeof out);
    for (uint32_t i = 0; i < size; i++) {
        const uint8_t got = t3_splitter_byte(splitter, out[i]);
        const uint8_t *frame = splitter->frame;
        if (!got)
            continue;
        CHECK(frame[0] & 0x80);
        if (frame[0] == T3_RECORD_IS) {
            const bool settings = frame[3] == T3_RECORD_SETTINGS && frame[6] == 0;
            const uint8_t channel = frame[8];
            CHECK(got == 23 && frame[4] <= T3_SETTINGS_OLD && (!settings || channel <= 125));
            set = (uint8_t)(set | (settings && channel != T3_RADIO_CHANNEL));
        }
        if (frame[0] != T3_KEY_IS)
            continue;
        CHECK(got == 8 && frame[3] <= T3_KEY_DAMAGED);
        if (frame[3] == T3_KEY_HELD && frame[2] == T3_RC_OK)
            CHECK(t3_get32(frame + 4) == check_of(wanted));
        if (frame[3] != T3_KEY_HELD)
            CHECK(t3_get32(frame + 4) == 0);
        written = (uint8_t)(written | (frame[3] == T3_KEY_HELD));
        refused = (uint8_t)(refused | (frame[2] == T3_RC_BUSY));
        damaged_starts = (uint8_t)(damaged_starts | (frame[3] == T3_KEY_DAMAGED));
    }
}

int main(void)
{
    struct t3_host_robot *robot = t3_host_robot_new();
    CHECK(robot);
    struct t3_splitter splitter;
    t3_splitter_start(&splitter);
    t3_host_robot_set_cell_us(robot, CELL_US);
    t3_host_robot_boot(robot, 1, 0);
    uint8_t before[T3_KEY_SIZE];
    for (uint64_t i = 0; i < FRAMES; i++) {
        uint8_t frame[T3_FRAME_LIMIT], wire[T3_WIRE_LIMIT], ack[T3_RADIO_LIMIT] = {0};
        const uint8_t size = make_frame(frame);
        uint8_t length = t3_to_wire(frame, size, wire);
        const bool damaged = fuzz_below(4) == 0;
        if (damaged)
            wire[fuzz_below(length - 1u)] ^= (uint8_t)(1u << fuzz_below(8));
        t3_host_robot_ack(robot, ack);
        const uint8_t status = t3_host_robot_status(robot);
        const bool may = !(status & (T3_STATUS_ENABLED | T3_STATUS_MOVING)) &&
                         !t3_host_robot_powered(robot) && !t3_host_robot_writing(robot);
        if (!damaged && frame[0] == T3_KEY && size == 18 && may) {
            memcpy(before, wanted, sizeof before);
            memcpy(wanted, frame + 2, sizeof wanted);
        }
        t3_host_robot_usb(robot, wire, length);
        if (fuzz_below(3) == 0)
            drive(robot, ack[1] ? ack[1] : 7);
        t3_host_robot_run(robot, fuzz_below(fuzz_below(10) ? 2000 : 100000));
        CHECK(!t3_host_robot_changing(robot) ||
              !(t3_host_robot_status(robot) & (T3_STATUS_ENABLED | T3_STATUS_MOVING)));
        check_cells(robot, before);
        read_console(robot, &splitter);
        if (fuzz_below(500) == 0) {
            // Damaged or not, the next key puts things right.
            t3_host_robot_boot(robot, 4, fuzz_next());
            memcpy(before, wanted, sizeof before);
            for (uint8_t j = 0; j < T3_KEY_SIZE; j++)
                wanted[j] = t3_host_robot_cell(robot, (uint8_t)(T3_STORE_KEY + j));
            t3_splitter_start(&splitter);
            read_console(robot, &splitter);
        }
    }
    printf("console: %lu frames, %lu EEPROM writes\n", FRAMES,
           (unsigned long)t3_host_robot_eeprom_writes(robot));
    CHECK(splitter.crc_errors == 0 && splitter.frame_errors == 0);
    CHECK(written && refused && damaged_starts && set);
    CHECK(t3_host_robot_eeprom_writes(robot) > FRAMES / 100);
    CHECK(t3_host_robot_unpowered_pulses(robot) == 0);
    t3_host_robot_free(robot);
    return 0;
}
