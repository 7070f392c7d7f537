// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
#include "t3_console.h"

#include <string.h>

#include "t3_bytes.h"
#include "t3_store.h"

#define KEY_ASK_SIZE 2u
#define KEY_SIZE (KEY_ASK_SIZE + T3_KEY_SIZE)
#define KEY_IS_SIZE 8u
#define SETTINGS_ASK_SIZE 2u
#define SETTINGS_SIZE 10u
#define SETTINGS_ARE_SIZE 12u
#define RECORD_SIZE (T3_KEY_SIZE + T3_CRC_SIZE)

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
        .settings = console->robot->settings.state,
        .channel = console->robot->settings.now.channel,
        .address = console->robot->settings.now.address,
    };
    uint8_t answer[T3_PONG_SIZE];
    reply(console, answer, t3_encode_pong(frame, &pong, answer));
}

static void tell_key(struct t3_console *console, uint8_t id, uint8_t rc)
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
        tell_key(console, frame[1], T3_RC_OK);
        return;
    }
    if (size != KEY_SIZE) {
        refuse(console, T3_ERR_MALFORMED, T3_KEY);
        return;
    }
    if (t3_console_writes(console) || !t3_robot_rests(console->robot)) {
        tell_key(console, frame[1], T3_RC_BUSY);
        return;
    }
    t3_session_lock(&console->robot->session);
    t3_session_mark_key(console->robot->port, true);
    memcpy(console->key, frame + KEY_ASK_SIZE, T3_KEY_SIZE);
    console->id = frame[1];
    console->step = T3_KEY_MARKED;
}

static void tell_settings(struct t3_console *console, uint8_t id, uint8_t rc)
{
    const struct t3_settings *settings = &console->robot->settings;
    uint8_t frame[SETTINGS_ARE_SIZE];
    uint8_t *to = t3_put8(frame, T3_SETTINGS_ARE);
    to = t3_put8(to, id);
    to = t3_put8(to, rc);
    to = t3_put8(to, settings->state);
    to = t3_put8(to, settings->now.channel);
    to = t3_put16(to, settings->now.microsteps);
    memcpy(to, settings->now.address, sizeof settings->now.address);
    reply(console, frame, sizeof frame);
}

static void take_settings(struct t3_console *console, const uint8_t *frame, uint8_t size)
{
    if (size == SETTINGS_ASK_SIZE) {
        tell_settings(console, frame[1], T3_RC_OK);
        return;
    }
    if (size != SETTINGS_SIZE) {
        refuse(console, T3_ERR_MALFORMED, T3_SETTINGS);
        return;
    }
    struct t3_setup setup = {.channel = frame[2], .microsteps = t3_get16(frame + 3)};
    memcpy(setup.address, frame + 5, sizeof setup.address);
    if (!t3_setup_valid(&setup)) {
        tell_settings(console, frame[1], T3_RC_RANGE);
        return;
    }
    if (t3_console_writes(console) || !t3_robot_rests(console->robot)) {
        tell_settings(console, frame[1], T3_RC_BUSY);
        return;
    }
    t3_session_end(&console->robot->session);
    t3_settings_write(&console->robot->settings, console->robot->port, &setup);
    console->id = frame[1];
    console->sets = true;
}

bool t3_console_writes(const struct t3_console *console)
{
    return console->step != T3_KEY_RESTS || console->robot->settings.step != T3_SETTINGS_IDLE;
}

static void end_key(struct t3_console *console, uint8_t rc)
{
    console->step = T3_KEY_RESTS;
    memset(console->key, 0, T3_KEY_SIZE);
    // After a failure the session remains locked, and the mark remains for the next boot.
    if (rc == T3_RC_OK)
        t3_session_boot(&console->robot->session, console->robot->port);
    tell_key(console, console->id, rc);
}

void t3_console_tick(struct t3_console *console)
{
    const struct t3_port *board = console->robot->port;
    const enum t3_progress progress =
        t3_settings_tick(&console->robot->settings, board, console->port);
    if (progress != T3_PROGRESS_NONE && console->sets) {
        console->sets = false;
        if (progress == T3_PROGRESS_DONE)
            t3_robot_use_settings(console->robot);
        tell_settings(console, console->id,
                      progress == T3_PROGRESS_DONE ? T3_RC_OK : T3_RC_FAILED);
    }
    if (console->step == T3_KEY_RESTS || !console->port->eeprom_settled(console->port->context))
        return;
    const bool record = console->step == T3_KEY_WRITTEN;
    if (!t3_store_verify(board, console->port, record ? T3_STORE_KEY : T3_STORE_KEY_MARK,
                         record ? RECORD_SIZE : 1)) {
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

bool t3_console_byte(struct t3_console *console, uint8_t byte)
{
    const uint8_t size = t3_splitter_byte(&console->splitter, byte);
    if (!size)
        return false;
    // The decoder keeps the frame until the next byte.
    const uint8_t *frame = console->splitter.frame;
    switch (frame[0]) {
    case T3_PING:
        take_ping(console, frame, size);
        break;
    case T3_KEY:
        take_key(console, frame, size);
        break;
    case T3_SETTINGS:
        take_settings(console, frame, size);
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
}
