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
#include "t3_log.h"

#include "t3_bytes.h"
#include "t3_robot_state.h"

#define BODY (T3_STORE_LOG_SIZE - T3_CRC_SIZE)
#define SECOND_US UINT32_C(1000000)

static uint16_t address(uint8_t place)
{
    return (uint16_t)(T3_STORE_LOG + place * T3_STORE_LOG_SIZE);
}

static void add(struct t3_log *log, const struct t3_port *port, uint8_t kind, uint16_t value)
{
    uint8_t body[BODY];
    uint8_t *to = t3_put32(body, log->number++);
    to = t3_put8(to, kind);
    to = t3_put8(to, 0);
    to = t3_put32(to, log->seconds);
    to = t3_put16(to, value);
    t3_put16(to, 0);
    t3_store_write(port, address(log->place), body, sizeof body);
    log->place = (uint8_t)((log->place + 1u) % T3_STORE_LOG_ENTRIES);
    log->logged = (uint16_t)(log->logged | 1u << kind);
}

void t3_log_boot(struct t3_log *log, const struct t3_port *port, const struct t3_robot *robot)
{
    uint8_t body[BODY];
    bool found = false;
    log->number = 0;
    log->place = 0;
    for (uint8_t place = 0; place < T3_STORE_LOG_ENTRIES; place++) {
        if (t3_store_read(port, address(place), body, sizeof body) != T3_RECORD_GOOD)
            continue;
        const uint32_t number = t3_get32(body);
        // The newest is the one behind which the numbers do not go on.
        if (found && t3_later_by(log->number, number) > 0)
            continue;
        found = true;
        log->number = number + 1u;
        log->place = (uint8_t)((place + 1u) % T3_STORE_LOG_ENTRIES);
    }
    log->logged = 0;
    log->longest = 0;
    log->seconds = 0;
    log->second_us = port->time_us(port->context);
    add(log, port, T3_LOG_BOOT, robot->reset_cause);
}

static bool once(const struct t3_log *log, uint8_t kind, bool present)
{
    return present && !(log->logged >> kind & 1u);
}

void t3_log_tick(struct t3_log *log, const struct t3_robot *robot, bool chip_ok, bool settled)
{
    const struct t3_port *port = robot->port;
    const uint32_t now_us = port->time_us(port->context);
    const uint16_t pass = robot->longest_us;
    while (now_us - log->second_us >= SECOND_US) {
        log->second_us += SECOND_US;
        log->seconds++;
    }
    // Kept until it can be written.
    if (pass > T3_LOG_LOOP_US && pass > log->longest + log->longest / 2u) {
        log->longest = pass;
        log->logged = (uint16_t)(log->logged & ~(1u << T3_LOG_LOOP));
    }
    if (!settled)
        return;
    const uint8_t records = t3_robot_records(robot);
    if (once(log, T3_LOG_RECORDS, records > T3_SETTINGS_ONE_COPY))
        add(log, port, T3_LOG_RECORDS, records);
    else if (once(log, T3_LOG_ESTOP, robot->estop))
        add(log, port, T3_LOG_ESTOP, 0);
    else if (once(log, T3_LOG_EXPIRED, robot->expired))
        add(log, port, T3_LOG_EXPIRED, robot->counters.expired);
    else if (once(log, T3_LOG_BATTERY, robot->flat))
        add(log, port, T3_LOG_BATTERY, t3_robot_battery(robot));
    else if (log->seconds && once(log, T3_LOG_IMU, robot->imu_fault))
        add(log, port, T3_LOG_IMU, 0);
    else if (log->seconds && once(log, T3_LOG_RADIO, !chip_ok))
        add(log, port, T3_LOG_RADIO, 0);
    else if (once(log, T3_LOG_LOOP, log->longest != 0))
        add(log, port, T3_LOG_LOOP, log->longest);
}

void t3_log_read(const struct t3_port *port, uint8_t place, uint8_t *entry)
{
    port->eeprom_read(port->context, address(place), entry, T3_STORE_LOG_SIZE);
}
