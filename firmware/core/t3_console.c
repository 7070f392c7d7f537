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
#include "t3_console.h"

#include <string.h>

#include "t3_bytes.h"
#include "t3_store.h"

#define KEY_ASK_SIZE 2u
#define KEY_SIZE (KEY_ASK_SIZE + T3_KEY_SIZE)
#define KEY_IS_SIZE 8u
#define KEY_RECORD_SIZE (T3_KEY_SIZE + T3_CRC_SIZE)
#define READ_SIZE 4u
#define STAGE_SIZE (READ_SIZE + T3_PART_SIZE)
#define STORE_SIZE 5u
#define RECORD_IS_SIZE (7u + T3_PART_SIZE)
#define SENSE_SIZE 2u
#define SENSE_IS_SIZE 32u
#define TX_HEAD 4u
#define RESULT_TIME 4u      // where the time of a RESULT is
#define STATUS_ANSWERED 3u  // acknowledged, with a payload
#define STATUS_SKIPPED 8u

static void reply(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    uint8_t wire[T3_WIRE_LIMIT];
    const uint8_t length = t3_to_wire(frame, size, wire);
    console->port->reply(console->port->context, wire, length);
}

static void refuse(struct t3_console *console, uint8_t code, uint8_t argument)
{
    const uint8_t frame[] = {T3_ERR, code, argument};
    reply(console, frame, sizeof frame);
}

static void take_ping(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    if (size != T3_PING_SIZE) {
        refuse(console, T3_ERR_MALFORMED, T3_PING);
        return;
    }
    const struct t3_port *board = console->robot->port;
    const struct t3_pong pong = {
        .time_us = board->time_us(board->context),
        .chip_ok = console->port->chip_ok(console->port->context),
        .crc_errors = console->splitter.crc_errors,
        .frame_errors = console->splitter.frame_errors,
        .overruns = console->overruns,
        .reset_cause = console->robot->reset_cause,
        .settings = t3_robot_records(console->robot),
        .channel = console->robot->settings.now.channel,
        .address = console->robot->settings.now.address,
    };
    uint8_t answer[T3_PONG_SIZE];
    reply(console, answer, t3_encode_pong(frame, &pong, answer));
}

static void send_key_state(struct t3_console *console, uint8_t id, uint8_t rc)
{
    const struct t3_session *session = &console->robot->session;
    uint8_t frame[KEY_IS_SIZE];
    uint8_t *to = t3_put8(frame, T3_KEY_IS);
    to = t3_put8(to, id);
    to = t3_put8(to, rc);
    to = t3_put8(to, session->locked  ? T3_KEY_DAMAGED
                     : session->keyed ? T3_KEY_HELD
                                      : T3_KEY_NONE);
    t3_put32(to, session->check);
    reply(console, frame, sizeof frame);
}

static bool all_zero(const uint8_t *data, uint8_t size)
{
    while (size--)
        if (*data++)
            return false;
    return true;
}

static void take_key(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    if (size == KEY_ASK_SIZE) {
        send_key_state(console, frame[1], T3_RC_OK);
        return;
    }
    if (size != KEY_SIZE) {
        refuse(console, T3_ERR_MALFORMED, T3_KEY);
        return;
    }
    if (t3_console_writes(console) || !t3_robot_rests(console->robot)) {
        send_key_state(console, frame[1], T3_RC_BUSY);
        return;
    }
    t3_session_lock(&console->robot->session);
    t3_session_mark_key(console->robot->port, true);
    memcpy(console->key, frame + KEY_ASK_SIZE, T3_KEY_SIZE);
    console->id = frame[1];
    console->step = T3_KEY_MARKED;
}

static void begin_write(struct t3_console *console, uint8_t record, uint8_t id)
{
    t3_session_end(&console->robot->session);
    console->sets = true;
    console->record = record;
    console->id = id;
}

// Return the state of a record, and its body in effect: t3_record_size bytes.
static uint8_t read_record(const struct t3_robot *robot, uint8_t record, uint8_t *body)
{
    if (record == T3_RECORD_SETTINGS) {
        t3_setup_encode(&robot->settings.now, body);
        return robot->settings.copies.state;
    }
    memcpy(body, robot->calibration.now, T3_CALIBRATION_BODY);
    return robot->calibration.copies.state;
}

static uint8_t record_size(uint8_t record)
{
    return record == T3_RECORD_SETTINGS ? T3_SETUP_BODY : T3_CALIBRATION_BODY;
}

static void send_part(struct t3_console *console, uint8_t id, uint8_t record, uint8_t part,
                      uint8_t rc)
{
    uint8_t body[T3_PARTS * T3_PART_SIZE] = {0};
    uint8_t frame[RECORD_IS_SIZE];
    uint8_t *to = t3_put8(frame, T3_RECORD_IS);
    to = t3_put8(to, id);
    to = t3_put8(to, rc);
    to = t3_put8(to, record);
    if (record < T3_RECORDS) {
        to = t3_put8(to, read_record(console->robot, record, body));
        to = t3_put8(to, record_size(record));
    } else {
        to = t3_put16(to, 0);
    }
    to = t3_put8(to, part);
    if (part < T3_PARTS)
        memcpy(to, body + part * T3_PART_SIZE, T3_PART_SIZE);
    else
        memset(to, 0, T3_PART_SIZE);
    reply(console, frame, sizeof frame);
}

static void send_log_entry(struct t3_console *console, uint8_t id, uint8_t place)
{
    uint8_t frame[RECORD_IS_SIZE];
    uint8_t *to = t3_put8(frame, T3_RECORD_IS);
    to = t3_put8(to, id);
    to = t3_put8(to, T3_RC_OK);
    to = t3_put8(to, T3_RECORD_LOG);
    to = t3_put8(to, T3_SETTINGS_GOOD);
    to = t3_put8(to, T3_STORE_LOG_ENTRIES * T3_STORE_LOG_SIZE - 1u);
    to = t3_put8(to, place);
    t3_log_read(console->robot->port, place, to);
    reply(console, frame, sizeof frame);
}

static void take_record(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    if (size != READ_SIZE && size != STAGE_SIZE) {
        refuse(console, T3_ERR_MALFORMED, T3_RECORD);
        return;
    }
    const uint8_t record = frame[2], part = frame[3];
    if (record == T3_RECORD_LOG && part < T3_STORE_LOG_ENTRIES && size == READ_SIZE) {
        send_log_entry(console, frame[1], part);
        return;
    }
    const bool known = record < T3_RECORDS && part * T3_PART_SIZE < record_size(record);
    if (known && size == STAGE_SIZE) {
        if (record != console->staged_record)
            memset(console->staged, 0, sizeof console->staged);
        console->staged_record = record;
        memcpy(console->staged + part * T3_PART_SIZE, frame + READ_SIZE, T3_PART_SIZE);
    }
    send_part(console, frame[1], record, part, known ? T3_RC_OK : T3_RC_UNKNOWN);
}

// Return T3_RC_OK if the staged bytes may be written.
static uint8_t check_staged(const struct t3_console *console, uint8_t record, uint16_t crc)
{
    if (record >= T3_RECORDS || record != console->staged_record ||
        crc != t3_crc16(console->staged, record_size(record)))
        return T3_RC_UNKNOWN;
    const bool valid = record == T3_RECORD_SETTINGS ? t3_setup_valid(console->staged)
                                                    : t3_calibration_valid(console->staged);
    if (!valid)
        return T3_RC_RANGE;
    return t3_console_writes(console) || !t3_robot_rests(console->robot) ? T3_RC_BUSY : T3_RC_OK;
}

static void take_store(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    if (size != STORE_SIZE) {
        refuse(console, T3_ERR_MALFORMED, T3_STORE);
        return;
    }
    const uint8_t record = frame[2];
    const uint8_t rc = check_staged(console, record, t3_get16(frame + 3));
    if (rc != T3_RC_OK) {
        send_part(console, frame[1], record, 0, rc);
        return;
    }
    struct t3_robot *robot = console->robot;
    if (record == T3_RECORD_SETTINGS)
        t3_settings_write(&robot->settings, robot->port, console->staged);
    else
        t3_calibration_write(&robot->calibration, robot->port, console->staged);
    begin_write(console, record, frame[1]);
}

// The newest samples of the converter and of the inertial sensor, raw; zeros while that does not answer.
static void take_sense(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    if (size != SENSE_SIZE) {
        refuse(console, T3_ERR_MALFORMED, T3_SENSE);
        return;
    }
    const struct t3_port *port = console->robot->port;
    struct t3_imu imu;
    if (!port->imu(port->context, &imu))
        memset(&imu, 0, sizeof imu);
    uint8_t answer[SENSE_IS_SIZE];
    uint8_t *to = t3_put8(answer, T3_SENSE_IS);
    to = t3_put8(to, frame[1]);
    for (uint8_t i = 0; i <= T3_ADC_BATTERY; i++)
        to = t3_put16(to, port->adc(port->context, i));
    const int16_t six[] = {imu.accel_x, imu.accel_y, imu.accel_z,
                           imu.gyro_x,  imu.gyro_y,  imu.gyro_z};
    for (uint8_t i = 0; i < 6; i++)
        to = t3_put16(to, (uint16_t)six[i]);
    reply(console, answer, sizeof answer);
}

// A transaction as that of a dongle, in three passes of the main loop, each of which is short: the first
// payload; its answer, which the second payload of a dongle would fetch, and the second payload; the reply.
static void take_tx(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    if (size < TX_HEAD || frame[3] < 1 || frame[3] > T3_RADIO_LIMIT ||
        size < TX_HEAD + frame[3] || size > TX_HEAD + frame[3] + T3_RADIO_LIMIT) {
        refuse(console, T3_ERR_MALFORMED, T3_TX);
        return;
    }
    if (console->tx != T3_TX_RESTS) {
        refuse(console, T3_ERR_BUSY, frame[1]);
        return;
    }
    const struct t3_port *board = console->robot->port;
    const uint8_t first = frame[3];
    console->second_size = (uint8_t)(size - TX_HEAD - first);
    memcpy(console->second, frame + TX_HEAD + first, console->second_size);
    uint8_t *to = t3_put8(console->result, T3_RESULT);
    to = t3_put8(to, frame[1]);
    to = t3_put8(to, STATUS_ANSWERED);
    t3_put8(to, console->second_size ? STATUS_ANSWERED : STATUS_SKIPPED);
    console->answer = t3_robot_cable(console->robot, frame + TX_HEAD, first,
                                     board->time_us(board->context));
    console->tx = T3_TX_TAKEN;
}

static void answer_tx(struct t3_console *console)
{
    struct t3_robot *robot = console->robot;
    const uint32_t now_us = robot->port->time_us(robot->port->context);
    uint8_t *to = t3_put32(console->result + RESULT_TIME, now_us);
    to += t3_robot_cable_answer(robot, console->answer, to);
    console->result_size = (uint8_t)(to - console->result);
    if (console->second_size)
        t3_robot_cable(robot, console->second, console->second_size, now_us);
}

static void continue_tx(struct t3_console *console)
{
    switch (console->tx) {
    case T3_TX_RESTS:
        return;
    case T3_TX_TAKEN:
        console->tx = T3_TX_DECODED;  // in the pass of the frame nothing more
        return;
    case T3_TX_DECODED:
        answer_tx(console);
        console->tx = T3_TX_ANSWERED;
        return;
    default:
        reply(console, console->result, console->result_size);
        console->tx = T3_TX_RESTS;
    }
}

bool t3_console_waits(const struct t3_console *console)
{
    return console->tx != T3_TX_RESTS || t3_console_writes(console);
}

bool t3_console_writes(const struct t3_console *console)
{
    const struct t3_robot *robot = console->robot;
    return console->step != T3_KEY_RESTS || robot->settings.copies.step != T3_COPIES_IDLE ||
           robot->calibration.copies.step != T3_COPIES_IDLE;
}

static void end_key(struct t3_console *console, uint8_t rc)
{
    console->step = T3_KEY_RESTS;
    memset(console->key, 0, T3_KEY_SIZE);
    // After a failure the session remains locked, and the mark remains for the next boot.
    if (rc == T3_RC_OK)
        t3_session_boot(&console->robot->session, console->robot->port);
    send_key_state(console, console->id, rc);
}

static void end_write(struct t3_console *console, uint8_t record, enum t3_progress progress)
{
    if (progress == T3_PROGRESS_NONE || !console->sets || record != console->record)
        return;
    console->sets = false;
    const uint8_t rc = progress == T3_PROGRESS_DONE ? T3_RC_OK : T3_RC_FAILED;
    if (rc == T3_RC_OK)
        t3_robot_use_settings(console->robot);
    send_part(console, console->id, record, 0, rc);
}

void t3_console_tick(struct t3_console *console)
{
    const struct t3_port *board = console->robot->port;
    continue_tx(console);
    end_write(console, T3_RECORD_SETTINGS,
              t3_settings_tick(&console->robot->settings, board, console->port));
    end_write(console, T3_RECORD_CALIBRATION,
              t3_calibration_tick(&console->robot->calibration, board, console->port));
    if (console->step == T3_KEY_RESTS || !console->port->eeprom_settled(console->port->context))
        return;
    const bool record = console->step == T3_KEY_WRITTEN;
    if (!t3_store_verify(board, console->port, record ? T3_STORE_KEY : T3_STORE_KEY_MARK,
                         record ? KEY_RECORD_SIZE : 1)) {
        end_key(console, T3_RC_FAILED);
        return;
    }
    switch (console->step) {
    case T3_KEY_MARKED:
        t3_session_store_key(board, all_zero(console->key, T3_KEY_SIZE) ? NULL : console->key);
        console->step = T3_KEY_WRITTEN;
        return;
    case T3_KEY_WRITTEN:
        t3_session_mark_key(board, false);
        console->step = T3_KEY_VERIFIED;
        return;
    default:
        end_key(console, T3_RC_OK);
    }
}

uint8_t t3_console_watch(struct t3_console *console)
{
    const struct t3_robot *robot = console->robot;
    const struct t3_console_port *port = console->port;
    const bool chip_ok = port->chip_ok(port->context);
    t3_log_tick(&console->log, robot, chip_ok, port->eeprom_settled(port->context));
    return t3_signal_tick(&console->signal, robot, chip_ok,
                          robot->port->time_us(robot->port->context));
}

bool t3_console_byte(struct t3_console *console, uint8_t byte)
{
    const uint8_t size = t3_splitter_byte(&console->splitter, byte);
    if (!size)
        return false;
    // The decoder keeps the frame until the next byte.
    const uint8_t *frame = console->splitter.frame;
    switch (frame[0]) {
    case T3_TX:
        take_tx(console, frame, size);
        break;
    case T3_PING:
        take_ping(console, frame, size);
        break;
    case T3_KEY:
        take_key(console, frame, size);
        break;
    case T3_RECORD:
        take_record(console, frame, size);
        break;
    case T3_STORE:
        take_store(console, frame, size);
        break;
    case T3_SENSE:
        take_sense(console, frame, size);
        break;
    default:
        refuse(console, T3_ERR_UNKNOWN, frame[0]);
    }
    return true;
}

void t3_console_overrun(struct t3_console *console)
{
    console->overruns++;
}

void t3_console_boot(struct t3_console *console, const struct t3_console_port *port,
                     struct t3_robot *robot)
{
    memset(console, 0, sizeof *console);
    console->port = port;
    console->robot = robot;
    t3_splitter_start(&console->splitter);
    t3_log_boot(&console->log, robot->port, robot);
    t3_signal_boot(&console->signal, robot->port->time_us(robot->port->context));
}
