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

// Robot: the reaction to each radio payload, and to silence.
//
// Nothing moves before HELLO and ENABLE. A command is valid for its TTL from the interrupt of the
// radio; on expiry the wheels ramp down. The newest command replaces the previous one; nothing is
// queued. An emergency stop is accepted from any sender and remains latched until the session clears
// it.
#ifndef T3_ROBOT_H
#define T3_ROBOT_H

#include "t3_robot_state.h"

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

// Boot: at rest, drivers off, no session.
void t3_robot_boot(struct t3_robot *robot, const struct t3_port *port, uint8_t reset_cause,
                   uint16_t settle_us);

// Process a radio payload; `received_us` is the time of the radio interrupt.
void t3_robot_packet(struct t3_robot *robot, const uint8_t *data, uint8_t size,
                     uint32_t received_us);

// Process a payload that came over the cable at `received_us`, under the rules of a radio payload; return
// what answers it. What the radio answers next stays.
struct t3_answer t3_robot_cable(struct t3_robot *robot, const uint8_t *data, uint8_t size,
                                uint32_t received_us);

// Write an answer to the cable, at most T3_RADIO_LIMIT bytes; return its size.
uint8_t t3_robot_cable_answer(struct t3_robot *robot, struct t3_answer answer, uint8_t *to);

// Call in each pass of the main loop, at least every 2 ms.
void t3_robot_tick(struct t3_robot *robot);

// Apply settings or a calibration that were written at rest; counters continue.
void t3_robot_use_settings(struct t3_robot *robot);

#endif
