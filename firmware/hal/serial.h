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

// The serial line to the board's USB chip: 500000 baud, 8N1, which 16 MHz divides without rest.
#ifndef SERIAL_H
#define SERIAL_H

#include <stdbool.h>
#include <stdint.h>

void serial_start(void);

// Take the oldest byte that came.
bool serial_take(uint8_t *byte);

// Return whether a byte is available. With interrupts disabled the result remains valid.
bool serial_waits(void);

// Send a frame, whole or not at all.
void serial_write(const uint8_t *data, uint8_t size);

// Return how often bytes were lost since the last call (at most 255).
uint8_t serial_lost(void);

#endif
