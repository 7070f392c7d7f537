// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Robot: the reaction to each radio payload, and to silence.
//
// Nothing moves before HELLO and ENABLE. A command is valid for its TTL from the interrupt of the
// radio; on expiry the wheels ramp down. The newest command replaces the previous one; nothing is
// queued. An emergency stop is accepted from any sender and remains latched until the session clears
// it.
#ifndef T3_ROBOT_H
#define T3_ROBOT_H

#include "t3_calibration.h"
#include "t3_parameters.h"
#include "t3_port.h"
#include "t3_protocol.h"
#include "t3_ramp.h"
#include "t3_session.h"
#include "t3_settings.h"
#include "t3_steps.h"

// `settle_us` of a port whose load_ack writes to the radio at once: a reply is loaded after the
// acknowledgement of its packet has been sent. The port of the AVR waits by itself, exactly and for
// retransmissions too (avr/robot_main.c), and uses 0.
#define T3_SETTLE_US 600u        // at 1 and 2 Mbit/s
#define T3_SETTLE_SLOW_US 1600u  // at 250 kbit/s
// Period at which the loaded reply is renewed without packets.
#define T3_REFRESH_US UINT32_C(100000)
// Period of the ramp, and of reading one range sensor.
#define T3_PERIOD_US UINT32_C(1000)
// Least deceleration of an emergency stop, mrad/s^2, whatever the parameter: no host can weaken it.
#define T3_ESTOP_DECELERATION INT32_C(60000)
// The button counts as pressed, or as released, after this time without a bounce or a spike.
#define T3_PRESS_US UINT32_C(5000)
#define T3_RELEASE_US UINT32_C(50000)
// Period of the battery measurement, whose low pass has a time constant of 8 periods.
#define T3_BATTERY_PERIOD_US UINT32_C(100000)
// Silence that ends a session: after a longer one, 32-bit clocks are ambiguous.
#define T3_SESSION_SILENCE_US UINT32_C(1800000000)

// Age of an echo that takes nothing from the TTL of a CMD: a cycle of the host and its transmission.
// With 0.1 s instead, a robot whose uplink fails would come to rest after 0.47 s, not 0.42 s.
#define T3_ECHO_AGE_US UINT32_C(50000)

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
    uint32_t battery_sum;  // 8 times its filtered voltage, mV; 0: not measured
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

// Boot: at rest, drivers off, no session.
void t3_robot_boot(struct t3_robot *robot, const struct t3_port *port, uint8_t reset_cause,
                   uint16_t settle_us);

// Process a radio payload; `received_us` is the time of the radio interrupt.
void t3_robot_packet(struct t3_robot *robot, const uint8_t *data, uint8_t size,
                     uint32_t received_us);

// Call in each pass of the main loop, at least every 2 ms.
void t3_robot_tick(struct t3_robot *robot);

// Return the filtered voltage of the battery, mV; 0 if it is not measured.
uint16_t t3_robot_battery(const struct t3_robot *robot);

// Apply settings or a calibration that were written at rest; counters continue.
void t3_robot_use_settings(struct t3_robot *robot);

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
