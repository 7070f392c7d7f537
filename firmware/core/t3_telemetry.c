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
#include "t3_telemetry.h"

#include <string.h>

#include "t3_bytes.h"
#include "t3_sensors.h"

#define AGE_UNIT_US 10u

static struct t3_imu sample_imu(struct t3_robot *robot)
{
    struct t3_imu imu;
    memset(&imu, 0, sizeof imu);
    robot->imu_fault = !robot->port->imu(robot->port->context, &imu);
    // What a sensor left behind when it failed is no measurement.
    if (robot->imu_fault)
        memset(&imu, 0, sizeof imu);
    return imu;
}

static void count_steps(const struct t3_robot *robot, int32_t *left, int32_t *right)
{
    const struct t3_port *port = robot->port;
    port->lock(port->context);
    *left = robot->steps.wheels[T3_LEFT].count;
    *right = robot->steps.wheels[T3_RIGHT].count;
    port->unlock(port->context);
}

static uint16_t age(const struct t3_robot *robot, uint32_t now_us)
{
    const uint32_t units = (now_us - robot->command_us) / AGE_UNIT_US;
    return robot->command_seen && units < T3_AGE_NONE ? (uint16_t)units : T3_AGE_NONE;
}

static uint8_t encode_state(struct t3_robot *robot, uint32_t now_us, uint8_t *to)
{
    const struct t3_imu imu = sample_imu(robot);
    struct t3_state state = {
        .session = robot->session.id,
        .seq = robot->seq,
        .status = t3_robot_status(robot),
        .time_us = now_us,
        .gyro_z = imu.gyro_z,
        .accel_x = imu.accel_x,
        .accel_y = imu.accel_y,
        .age = age(robot, now_us),
    };
    count_steps(robot, &state.left, &state.right);
    memcpy(state.ranges, robot->ranges, T3_RANGES);
    return t3_encode_state(&state, to);
}

static uint8_t encode_aux(struct t3_robot *robot, uint8_t *to)
{
    const struct t3_imu imu = sample_imu(robot);
    struct t3_aux aux = {
        .session = robot->session.id,
        .seq = robot->answer.seq,
        .status = t3_robot_status(robot),
        .battery = t3_robot_battery(robot),
        .temperature = imu.temperature,
        .accel_z = imu.accel_z,
        .gyro_x = imu.gyro_x,
        .gyro_y = imu.gyro_y,
        .counters = robot->counters,
        .refusal = robot->refusal,
    };
    memcpy(aux.refused, robot->refused, T3_HEADER_SIZE);
    return t3_encode_aux(&aux, to);
}

static uint8_t encode_info(const struct t3_robot *robot, uint8_t *to)
{
    const struct t3_info info = {
        .version = robot->answer.version,
        .session = robot->session.id,
        .seq = robot->answer.seq,
        .protocol = T3_VERSION,
        .major = T3_FIRMWARE_MAJOR,
        .minor = T3_FIRMWARE_MINOR,
        .reset_cause = robot->reset_cause,
        .parameters = T3_PARAMETERS,
        .steps_per_rev = (uint16_t)robot->parameters.values[T3_STEPS_PER_REV],
        .microsteps = robot->microsteps,
        .refusal = robot->refusal,
        .settings = t3_robot_records(robot),
        .channel = robot->settings.now.channel,
        .address = robot->settings.now.address,
        .build = T3_BUILD,
        .nonce = robot->session.keyed ? robot->session.robot_nonce : NULL,
    };
    return t3_encode_info(&info, to);
}

static uint8_t encode_param(const struct t3_robot *robot, uint8_t *to)
{
    const uint8_t id = robot->answer.id;
    const struct t3_bounds *bounds = t3_parameter_bounds(id);
    struct t3_param param = {
        .session = robot->session.id,
        .seq = robot->answer.seq,
        .id = id,
        .rc = robot->answer.rc,
    };
    if (bounds) {
        param.value = robot->parameters.values[id];
        param.low = bounds->low;
        param.high = bounds->high;
    }
    return t3_encode_param(&param, to);
}

uint8_t t3_telemetry(struct t3_robot *robot, uint32_t now_us, uint8_t *to)
{
    const struct t3_answer *answer = &robot->answer;
    switch (answer->kind) {
    case T3_AUX:
        return encode_aux(robot, to);
    case T3_INFO:
        return encode_info(robot, to);
    case T3_PARAM:
        return encode_param(robot, to);
    case T3_ACK:
        return t3_encode_ack(robot->session.id, answer->seq, answer->id, answer->rc, to);
    default:
        return encode_state(robot, now_us, to);
    }
}
