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

// Random packets into the robot, with time passing: no fault, and the rules that always hold.

#include <stdbool.h>
#include <stdio.h>
#include <string.h>

#include "fuzz.h"
#include "t3_bytes.h"
#include "t3_host.h"
#include "t3_parameters.h"
#include "t3_protocol.h"
#include "t3_siphash.h"

#define PACKETS 1000000ul
#define HEADER (T3_VERSION << 4)

static const uint8_t KEY[T3_KEY_SIZE] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

static uint8_t session;  // session in the answers of the robot
static uint8_t seq;

static uint8_t common_session(void)
{
    return fuzz_below(8) ? session : fuzz_byte();
}

// A frame with everything in its place, and numbers that reach far into the rules.
static uint8_t plausible(uint8_t *data, uint32_t now_us)
{
    static const uint8_t SIZES[2][7] = {{0, 14, 4, 8, 4, 4, 6}, {0, 26, 4, 20, 24, 4, 18}};
    const uint8_t kind = (uint8_t)(1 + fuzz_below(6));
    const uint8_t size = SIZES[fuzz_below(4) == 0][kind];
    for (uint8_t i = 0; i < T3_RADIO_LIMIT; i++)
        data[i] = fuzz_byte();
    data[0] = (uint8_t)(HEADER | kind);
    data[1] = common_session();
    data[2] = fuzz_below(10) ? ++seq : fuzz_byte();
    data[3] = (uint8_t)fuzz_below(kind == T3_CMD ? 8 : 12);
    if (kind == T3_CMD) {
        if (fuzz_below(4))
            data[3] = T3_FLAG_ENABLE;
        if (fuzz_below(10))
            data[5] = 0;
        t3_put32(data + 10, now_us - 1000 - fuzz_below(fuzz_below(10) ? 1000 : 1000000));
    } else if (kind == T3_HELLO) {
        data[3] = size == 24;
    } else if (kind == T3_ACTION) {
        t3_put16(data + 4, 0);
    } else if (kind == T3_PARAM_SET && fuzz_below(2)) {
        t3_put32(data + 4, fuzz_below(20000));
    }
    return size;
}

// What a host would send: it brings the robot back to where the rules of motion are tried.
static uint8_t earnest(uint8_t *data, uint8_t status, uint32_t now_us)
{
    memset(data, 0, T3_RADIO_LIMIT);
    if (status & T3_STATUS_NO_SESSION) {
        data[0] = HEADER | T3_HELLO;
        data[1] = (uint8_t)(1 + fuzz_below(255));
        return 4;
    }
    data[1] = session;
    data[2] = ++seq;
    if (fuzz_below(50) == 0) {
        data[0] = HEADER | T3_PARAM_SET;
        data[3] = (uint8_t)fuzz_below(4);
        t3_put32(data + 4, data[3] == T3_TTL_MAX ? 250 : 15000);
        return 8;
    }
    data[0] = HEADER | T3_CMD;
    t3_put32(data + 10, now_us - 1000);
    if (status & T3_STATUS_ESTOP) {
        data[3] = T3_FLAG_ESTOP_CLEAR;
        return T3_CMD_SIZE;
    }
    data[3] = T3_FLAG_ENABLE;
    data[4] = (uint8_t)fuzz_below(30);
    t3_put16(data + 6, (uint16_t)fuzz_next());
    t3_put16(data + 8, (uint16_t)fuzz_next());
    return T3_CMD_SIZE;
}

static uint8_t any(uint8_t *data)
{
    for (uint8_t i = 0; i < 40; i++)
        data[i] = fuzz_byte();
    if (fuzz_below(2))
        data[0] = (uint8_t)(HEADER | (data[0] & 7));
    return (uint8_t)fuzz_below(41);
}

static void disturb(struct t3_host_robot *robot)
{
    int16_t seven[7];
    for (int i = 0; i < 7; i++)
        seven[i] = t3_signed16((uint16_t)fuzz_next());
    t3_host_robot_set_imu(robot, fuzz_below(4) != 0, seven);
    t3_host_robot_set_adc(robot, (uint8_t)fuzz_below(9), (uint16_t)fuzz_next());
    t3_host_robot_press(robot, fuzz_below(8) == 0);
    if (fuzz_below(50) == 0)
        t3_host_robot_poke_time(robot, 0u - fuzz_below(100000));
    if (fuzz_below(50) == 0) {
        // Nearly the end of the counters: a step more must not be undefined.
        t3_host_robot_poke_steps(robot, 0, INT32_MAX - (int32_t)fuzz_below(3));
        t3_host_robot_poke_steps(robot, 1, INT32_MIN + (int32_t)fuzz_below(3));
    }
}

static void check_rules(struct t3_host_robot *robot, bool keyed)
{
    uint8_t ack[T3_RADIO_LIMIT];
    const uint8_t size = t3_host_robot_ack(robot, ack);
    const uint8_t status = t3_host_robot_status(robot);
    const int32_t left = t3_host_robot_speed(robot, 0), right = t3_host_robot_speed(robot, 1);
    if (!size)
        return;  // it has just started
    CHECK(size == T3_STATE_SIZE || size == T3_PARAM_SIZE || size == T3_ACK_SIZE ||
          size == T3_INFO_SIZE + (keyed ? T3_NONCE_SIZE : 0));
    // A host of another version is answered with INFO only, in its own version.
    CHECK(ack[0] >> 4 == T3_VERSION || (ack[0] & 0x0F) == T3_INFO);
    session = ack[1];
    if (status & (T3_STATUS_NO_SESSION | T3_STATUS_ESTOP))
        CHECK(!(status & T3_STATUS_ENABLED));
    CHECK(!(status & T3_STATUS_MOVING) == !(left || right));
    CHECK(!(status & T3_STATUS_MOVING) || t3_host_robot_powered(robot));
    CHECK(left <= 19600000 && left >= -19600000 && right <= 19600000 && right >= -19600000);
    if (keyed)
        CHECK(!left && !right && (status & T3_STATUS_NO_SESSION));
}

// With other microsteps: they come from the settings only, and not from packets.
static void boot_anew(struct t3_host_robot *robot)
{
    static const uint8_t ADDRESS[] = {'T', '3', 'M', 'P', 'C'};
    t3_host_robot_store_settings(robot, 82, (uint16_t)(1u << fuzz_below(9)), ADDRESS);
    t3_host_robot_boot(robot, fuzz_byte(), fuzz_next());
}

static void fuzz(const char *what, bool keyed)
{
    struct t3_host_robot *robot = t3_host_robot_new();
    CHECK(robot);
    if (keyed)
        t3_host_robot_store_key(robot, KEY);
    uint64_t moving = 0, travelled = 0;
    t3_host_robot_boot(robot, 1, 0u - 1000000u);
    for (uint64_t i = 0; i < PACKETS; i++) {
        uint8_t data[40];
        const uint32_t now_us = t3_host_robot_time(robot), kind = fuzz_below(10);
        const uint8_t size = kind < 6   ? earnest(data, t3_host_robot_status(robot), now_us)
                             : kind < 9 ? plausible(data, now_us)
                                        : any(data);
        t3_host_robot_packet(robot, data, size);
        const int32_t before = t3_host_robot_pulses(robot, 0);
        t3_host_robot_run(robot, fuzz_below(100) ? fuzz_below(4000) : fuzz_below(400000));
        travelled += (uint64_t)labs((long)t3_host_robot_pulses(robot, 0) - before);
        if (fuzz_below(20) == 0)
            disturb(robot);
        if (fuzz_below(20000) == 0)
            boot_anew(robot);
        check_rules(robot, keyed);
        moving += (t3_host_robot_status(robot) & T3_STATUS_MOVING) != 0;
    }
    printf("robot, %s: %lu packets, moving after %llu, %llu steps, closest pulses %lu us\n", what,
           PACKETS, (unsigned long long)moving, (unsigned long long)travelled,
           (unsigned long)t3_host_robot_closest_pulses(robot));
    CHECK(keyed ? travelled == 0 : travelled > 1000000);
    CHECK(t3_host_robot_closest_pulses(robot) >= 100);
    CHECK(t3_host_robot_unpowered_pulses(robot) == 0);
    CHECK(t3_host_robot_hasty_pulses(robot) == 0);
    t3_host_robot_free(robot);
}

int main(void)
{
    fuzz("no key", false);
    fuzz("key, and none of the packets signed with it", true);
    return 0;
}
