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

// What the core stores, in the EEPROM: read from a copy, written back a byte at a time whenever
// the EEPROM is ready, because a byte takes it 3.4 ms.
#ifndef MEMORY_H
#define MEMORY_H

#include <stdbool.h>
#include <stdint.h>

void memory_start(void);
void memory_read(uint16_t address, uint8_t *data, uint8_t size);
void memory_write(uint16_t address, const uint8_t *data, uint8_t size);

// Return whether all writes are complete.
bool memory_settled(void);

// Read the cells themselves. Waits if one is being written.
void memory_cells(uint16_t address, uint8_t *data, uint8_t size);

// Write the next byte that differs, if there is one. Never waits.
void memory_work(void);

#endif
