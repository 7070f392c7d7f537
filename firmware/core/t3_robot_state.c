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
#include "t3_robot_state.h"

void t3_answer_with(struct t3_robot *robot, uint8_t kind, uint8_t seq, uint8_t id, uint8_t rc)
{
    const struct t3_answer wanted = {kind, seq, id, rc, T3_VERSION};
    robot->answer = wanted;
}

bool t3_robot_rests(const struct t3_robot *robot)
{
    // Enabled, but its drivers not yet powered: the tick in between has not come.
    return !robot->enabled && !robot->powered && !t3_ramp_busy(&robot->ramp);
}

uint16_t t3_robot_battery(const struct t3_robot *robot)
{
    return (uint16_t)(robot->battery_sum / T3_BATTERY_WEIGHT);
}

void t3_robot_invert(struct t3_robot *robot)
{
    robot->port->lock(robot->port->context);
    robot->steps.inverted =
        (uint8_t)(robot->settings.now.inverted ^ (uint8_t)robot->parameters.values[T3_INVERT_WHEELS]);
    robot->port->unlock(robot->port->context);
}

uint8_t t3_robot_records(const struct t3_robot *robot)
{
    if (t3_settings_usable(&robot->settings) && !t3_calibration_usable(&robot->calibration))
        return T3_SETTINGS_CALIBRATION;
    return robot->settings.copies.state;
}

uint8_t t3_robot_status(const struct t3_robot *robot)
{
    const uint16_t supply = t3_robot_battery(robot);
    uint8_t status = 0;
    if (robot->enabled)
        status |= T3_STATUS_ENABLED;
    if (t3_ramp_moving(&robot->ramp))
        status |= T3_STATUS_MOVING;
    if (robot->estop)
        status |= T3_STATUS_ESTOP;
    if (robot->expired)
        status |= T3_STATUS_TTL_EXPIRED;
    if (robot->imu_fault)
        status |= T3_STATUS_IMU_FAULT;
    // 0: nothing is wired to it, unless the settings say so
    if ((supply || robot->settings.now.wired) && supply < robot->parameters.values[T3_BATTERY_LOW])
        status |= T3_STATUS_LOW_BATTERY;
    if (!robot->session.id)
        status |= T3_STATUS_NO_SESSION;
    if (robot->limited)
        status |= T3_STATUS_LIMITED;
    return status;
}
