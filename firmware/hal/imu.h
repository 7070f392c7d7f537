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

// MPU6050 (PS-MPU-6000A): +-500 deg/s, +-2 g, 44 Hz low pass, read every 2 ms by interrupts. It may
// be absent, and come back.
#ifndef IMU_H
#define IMU_H

#include <stdbool.h>
#include <stdint.h>

#include "t3_port.h"

void imu_start(void);

// Take what is ready and begin the next transfer when it is time. Never waits.
void imu_work(uint32_t now_us);

// The newest sample; false while the sensor does not answer.
bool imu_sample(struct t3_imu *sample);

#endif
