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
#include "t3_requests.h"

#include <string.h>


static void get_parameter(struct t3_robot *robot, const struct t3_packet *packet)
{
    const bool known = t3_parameter_bounds(packet->what) != 0;
    t3_answer_with(robot, T3_PARAM, packet->seq, packet->what, known ? T3_RC_OK : T3_RC_UNKNOWN);
}

static void set_parameter(struct t3_robot *robot, const struct t3_packet *packet)
{
    const uint8_t id = packet->what;
    const uint8_t rc =
        t3_parameter_set(&robot->parameters, id, packet->value, t3_ramp_busy(&robot->ramp));
    if (rc == T3_RC_OK && id == T3_INVERT_WHEELS)
        t3_robot_invert(robot);
    t3_answer_with(robot, T3_PARAM, packet->seq, id, rc);
}

static uint8_t reset_odometry(struct t3_robot *robot)
{
    if (t3_ramp_busy(&robot->ramp))
        return T3_RC_BUSY;
    robot->port->lock(robot->port->context);
    robot->steps.wheels[T3_LEFT].count = robot->steps.wheels[T3_RIGHT].count = 0;
    robot->port->unlock(robot->port->context);
    return T3_RC_OK;
}

static uint8_t act(struct t3_robot *robot, uint8_t verb)
{
    switch (verb) {
    case T3_RESET_ODOMETRY:
        return reset_odometry(robot);
    case T3_CLEAR_COUNTERS:
        memset(&robot->counters, 0, sizeof robot->counters);
        memset(robot->refused, 0, sizeof robot->refused);
        robot->refusal = T3_ADMITTED;
        return T3_RC_OK;
    default:
        return T3_RC_UNKNOWN;
    }
}

static void take_action(struct t3_robot *robot, const struct t3_packet *packet)
{
    // A host that missed the reply repeats the request; the action runs only once.
    if (!robot->action_done || packet->seq != robot->action_seq ||
        packet->what != robot->action_verb) {
        robot->action_rc = act(robot, packet->what);
        robot->action_done = true;
        robot->action_seq = packet->seq;
        robot->action_verb = packet->what;
    }
    t3_answer_with(robot, T3_ACK, packet->seq, packet->what, robot->action_rc);
}

void t3_request(struct t3_robot *robot, const struct t3_packet *packet)
{
    if (packet->kind == T3_PARAM_GET)
        get_parameter(robot, packet);
    else if (packet->kind == T3_PARAM_SET)
        set_parameter(robot, packet);
    else
        take_action(robot, packet);
}
