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

// Calibration of a robot in EEPROM, in two copies (t3_copies.h), written over its own USB only.
//
// Each value has a standard uncertainty; 0 means that it was not calibrated, and then it is 0 too. The
// robot itself uses the correction of the divider and the curves of the distance sensors; it stores the
// rest for the host. A robot that was never calibrated drives; one with a damaged calibration does not:
// it would drive with nominal values again, without a sign of it.
#ifndef T3_CALIBRATION_H
#define T3_CALIBRATION_H

#include "t3_copies.h"
#include "t3_port.h"
#include "t3_sensors.h"

#define T3_CALIBRATION_BODY (T3_STORE_CALIBRATION_SIZE - T3_CRC_SIZE)

struct t3_calibration {
    uint8_t now[T3_CALIBRATION_BODY];  // in effect, as in the record; nothing calibrated without one
    struct t3_copies copies;
};

// Read the record; begin to repair a damaged or differing copy.
void t3_calibration_boot(struct t3_calibration *calibration, const struct t3_port *port);

// Return whether a session may start: the record is valid, or was never written.
bool t3_calibration_usable(const struct t3_calibration *calibration);

// Return whether the values of a body are possible.
bool t3_calibration_valid(const uint8_t *body);

// Begin to write both copies; until t3_calibration_tick reports the end, the record counts as damaged.
void t3_calibration_write(struct t3_calibration *calibration, const struct t3_port *port,
                          const uint8_t *body);

// Call in each pass of the main loop; return whether a write has just ended. Once it is done, the new
// values are in effect.
enum t3_progress t3_calibration_tick(struct t3_calibration *calibration,
                                     const struct t3_port *port,
                                     const struct t3_console_port *console);

// Return a battery voltage (mV) with the correction of the divider; 0, not measured, remains 0.
uint16_t t3_calibration_battery(const struct t3_calibration *calibration, uint16_t voltage);

// Return whether a distance sensor is calibrated; then write its curve.
bool t3_calibration_curve(const struct t3_calibration *calibration, uint8_t sensor,
                          struct t3_curve *curve);

#endif
