// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Uplink payloads of the robot.
#ifndef T3_TELEMETRY_H
#define T3_TELEMETRY_H

#include "t3_robot_state.h"

// Write the payload of the pending reply, sampled now; return its size.
uint8_t t3_telemetry(struct t3_robot *robot, uint32_t now_us, uint8_t *to);

#endif
