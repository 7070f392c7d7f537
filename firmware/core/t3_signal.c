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
#include "t3_signal.h"

#include "t3_robot_state.h"

#define STEP_US UINT32_C(100000)
#define STEPS 20u
#define BOOT_US UINT32_C(1000000)
#define BEEP_ROUNDS 1u   // the buzzer sounds when a fault begins,
#define ALARM_ROUNDS 15u // and a low battery again after each 30 s

uint8_t t3_signal_code(const struct t3_robot *robot, bool chip_ok, uint32_t uptime_us)
{
    const uint8_t status = t3_robot_status(robot);
    if (uptime_us < BOOT_US)
        return T3_SIGNAL_BOOTING;
    if (robot->estop)
        return T3_SIGNAL_ESTOP;
    if (t3_robot_records(robot) > T3_SETTINGS_ONE_COPY || robot->session.locked)
        return T3_SIGNAL_LOCKED;
    if (!chip_ok)
        return T3_SIGNAL_RADIO;
    if (status & T3_STATUS_LOW_BATTERY)
        return T3_SIGNAL_BATTERY;
    if (robot->imu_fault)
        return T3_SIGNAL_SENSOR;
    if (status & T3_STATUS_NO_SESSION)
        return T3_SIGNAL_NO_SESSION;
    return robot->enabled ? T3_SIGNAL_DRIVING : T3_SIGNAL_STANDING;
}

uint8_t t3_signal_levels(uint8_t code, uint8_t step, uint8_t round)
{
    switch (code) {
    case T3_SIGNAL_BOOTING:
    case T3_SIGNAL_DRIVING:
        return T3_SIGNAL_LED;
    case T3_SIGNAL_NO_SESSION:
        return step < STEPS / 2 ? T3_SIGNAL_LED : 0;
    case T3_SIGNAL_STANDING:
        return step ? T3_SIGNAL_LED : 0;
    default:
        break;
    }
    // As many flashes as the number of the code, 0.1 s on and 0.2 s off.
    if (step % 3 != 0 || step / 3 >= code)
        return 0;
    const bool beeps = code == T3_SIGNAL_BATTERY ? round % ALARM_ROUNDS < BEEP_ROUNDS
                                                 : round < BEEP_ROUNDS;
    return beeps ? T3_SIGNAL_LED | T3_SIGNAL_BUZZER : T3_SIGNAL_LED;
}

uint8_t t3_signal_tick(struct t3_signal *signal, const struct t3_robot *robot, bool chip_ok,
                       uint32_t now_us)
{
    if (now_us - signal->step_us >= STEP_US) {
        signal->step_us = now_us;
        signal->step++;
        if (signal->step >= STEPS) {
            signal->step = 0;
            // The round of a fault that is long past its beeps need not be counted further.
            signal->rounds = (uint8_t)(signal->rounds < 240u ? signal->rounds + 1u : 225u);
        }
    }
    const uint8_t code =
        t3_signal_code(robot, chip_ok, signal->booted ? UINT32_MAX : now_us - signal->boot_us);
    signal->booted = signal->booted || code != T3_SIGNAL_BOOTING;
    if (code != signal->code) {
        signal->code = code;
        signal->step = signal->rounds = 0;
        signal->step_us = now_us;
    }
    return t3_signal_levels(code, signal->step, signal->rounds);
}

void t3_signal_boot(struct t3_signal *signal, uint32_t now_us)
{
    signal->code = T3_SIGNAL_BOOTING;
    signal->booted = false;
    signal->boot_us = signal->step_us = now_us;
    signal->step = signal->rounds = 0;
}
