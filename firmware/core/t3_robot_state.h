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

// State of the robot, and what is read from it.
#ifndef T3_ROBOT_STATE_H
#define T3_ROBOT_STATE_H

#include "t3_calibration.h"
#include "t3_parameters.h"
#include "t3_port.h"
#include "t3_protocol.h"
#include "t3_ramp.h"
#include "t3_session.h"
#include "t3_settings.h"
#include "t3_steps.h"

#define T3_BATTERY_WEIGHT 8u

// Kind of the frame to load next, and the request it replies to.
struct t3_answer {
    uint8_t kind, seq, id, rc;
    uint8_t version;  // of the request
};

struct t3_robot {
    const struct t3_port *port;
    struct t3_steps steps;  // shared with the step interrupt: see t3_steps.h
    struct t3_ramp ramp;
    struct t3_session session;
    struct t3_settings settings;
    struct t3_calibration calibration;
    struct t3_parameters parameters;
    struct t3_counters counters;
    uint8_t refusal;                  // enum t3_refusal of the newest refused payload
    uint8_t refused[T3_HEADER_SIZE];  // its first bytes
    uint32_t period_us;  // start of the last period
    uint32_t tick_us;    // last call of t3_robot_tick
    uint16_t longest_us;  // longest time between two of them, 65535 at most

    bool enabled;   // commands may move the wheels
    bool estop;     // latched
    bool expired;   // the TTL has expired
    bool limited;   // the last command was scaled down
    bool powered;   // drivers are on
    bool imu_fault;
    bool pressed;         // the button, debounced
    uint32_t button_us;   // last time at which its input agreed with `pressed`
    uint32_t battery_us;  // last measurement of the battery
    uint32_t battery_sum;  // T3_BATTERY_WEIGHT times its filtered voltage, mV; 0: not measured
    bool flat;             // below the cut-off, and not yet charged
    bool resting, idle;  // wheels at rest; idle time exceeded
    uint32_t rest_us;    // start of the rest

    bool ttl_runs;
    uint32_t ttl_from_us, ttl_us;
    bool seq_known, command_seen;
    uint8_t seq;              // of the last CMD
    uint32_t command_us;      // its reception
    uint32_t last_frame_us;   // reception of the last frame of the session

    bool action_done;
    uint8_t action_seq, action_verb, action_rc;

    bool answer_waits;
    uint32_t answer_from_us;  // reception of the packet to reply to
    uint32_t loaded_us;
    struct t3_answer answer;

    uint8_t ranges[T3_RANGES], next_range;  // codes, and the sensor to read next

    uint8_t reset_cause;
    uint16_t settle_us;
    uint16_t microsteps;  // effective
    int32_t top_speed;    // mrad/s at these microsteps
};

// Return the filtered voltage of the battery, mV; 0 if it is not measured.
uint16_t t3_robot_battery(const struct t3_robot *robot);

// Return the state of the records in INFO and PONG: of the settings, or T3_SETTINGS_CALIBRATION.
uint8_t t3_robot_records(const struct t3_robot *robot);

// Set the direction of the wheels: that of the settings, reversed by the parameter.
void t3_robot_invert(struct t3_robot *robot);

// Return whether the robot is disabled and stopped, and its drivers are off.
bool t3_robot_rests(const struct t3_robot *robot);

// Set the reply that the next packet fetches: its kind, and the request it replies to.
void t3_answer_with(struct t3_robot *robot, uint8_t kind, uint8_t seq, uint8_t id, uint8_t rc);

// Return the status byte of STATE, INFO and AUX.
uint8_t t3_robot_status(const struct t3_robot *robot);

#endif
