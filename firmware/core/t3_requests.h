// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// PARAM_GET, PARAM_SET and ACTION: the host may repeat each until it receives the reply.
#ifndef T3_REQUESTS_H
#define T3_REQUESTS_H

#include "t3_robot_state.h"

// Execute a request of the session, and prepare the reply.
void t3_request(struct t3_robot *robot, const struct t3_packet *packet);

#endif
