// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The robot: what it does with each radio payload, and with their absence.
//
// Nothing moves before HELLO and ENABLE. A command holds for its TTL, counted from the radio's
// interrupt; then the wheels ramp down. The newest wins, nothing is queued. An emergency stop is
// honoured from anybody and stays latched until the robot's own session clears it.
#ifndef T3_ROBOT_H
#define T3_ROBOT_H

#include "t3_freshness.h"
#include "t3_parameters.h"
#include "t3_port.h"
#include "t3_protocol.h"
#include "t3_ramp.h"
#include "t3_session.h"
#include "t3_steps.h"

// `settle_us` of a port whose load_ack goes to the radio at once: an answer is made when the
// acknowledgement of the packet before is off the air. The AVR's port waits by itself, to the
// microsecond and for repetitions too (avr/robot_main.c): it has its answers made at once, with 0.
#define T3_SETTLE_US 600u        // at 1 and 2 Mbit/s
#define T3_SETTLE_SLOW_US 1600u  // at 250 kbit/s
// Nobody asks: what waits in the radio is made anew so often.
#define T3_REFRESH_US UINT32_C(100000)
// So often the ramp moves on and one of the distance sensors is read.
#define T3_PERIOD_US UINT32_C(1000)
// A session ends after so long a silence: beyond it, clocks of 32 bits become ambiguous.
#define T3_SESSION_SILENCE_US UINT32_C(1800000000)

// What is loaded next, and for which request.
struct t3_answer {
    uint8_t kind, seq, id, rc;
};

struct t3_robot {
    const struct t3_port *port;
    struct t3_steps steps;  // shared with the stepping interrupt: see t3_steps.h
    struct t3_ramp ramp;
    struct t3_session session;
    struct t3_freshness freshness;
    struct t3_parameters parameters;
    struct t3_counters counters;
    uint32_t period_us;  // when the last period began

    bool enabled;   // commands may move the wheels
    bool estop;     // latched
    bool expired;   // the TTL ran out
    bool limited;   // the last command was scaled down
    bool powered;   // the drivers are
    bool imu_fault;
    bool resting, idle;  // the wheels stand; they have for as long as the drivers keep power
    uint32_t rest_us;    // since when they stand

    bool ttl_runs;
    uint32_t ttl_from_us, ttl_us;
    bool seq_known, command_seen;
    uint8_t seq;              // of the last CMD
    uint32_t command_us;      // its reception
    uint32_t heard_us;        // reception of the last frame of the session

    bool action_done;
    uint8_t action_seq, action_verb, action_rc;

    bool answer_waits;
    uint32_t answer_from_us;  // packet that is answered
    uint32_t loaded_us;
    struct t3_answer answer;

    uint8_t ranges[T3_RANGES], next_range;  // codes, and which is read next

    uint8_t reset_cause;
    uint16_t settle_us;
    uint16_t microsteps;  // in force
    int32_t top_speed;    // mrad/s that these allow
};

// Start at rest, drivers without power, no session.
void t3_robot_boot(struct t3_robot *robot, const struct t3_port *port, uint8_t reset_cause,
                   uint16_t settle_us);

// Take a radio payload; `received_us` is when the radio's interrupt came.
void t3_robot_packet(struct t3_robot *robot, const uint8_t *data, uint8_t size,
                     uint32_t received_us);

// Call as often as the main loop runs, at least every millisecond or two.
void t3_robot_tick(struct t3_robot *robot);

// Return whether the robot stands and its drivers have no power.
bool t3_robot_rests(const struct t3_robot *robot);

// What the next packet fetches: a kind of payload, and the request it answers.
void t3_answer_with(struct t3_robot *robot, uint8_t kind, uint8_t seq, uint8_t id, uint8_t rc);

// Status byte of STATE, INFO and AUX.
uint8_t t3_robot_status(const struct t3_robot *robot);

#endif
