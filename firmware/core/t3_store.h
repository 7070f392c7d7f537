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

// Records in EEPROM, each with a CRC, which detects blank records and writes interrupted by a loss of
// power.
#ifndef T3_STORE_H
#define T3_STORE_H

#include "t3_port.h"

#define T3_STORE_KEY 8u         // 16 bytes
#define T3_STORE_KEY_MARK 26u   // a byte: 0xFF, or another value during the write of a key
                                // until it is verified
#define T3_STORE_BOOTS 32u      // u32
#define T3_STORE_SETTINGS 40u       // see t3_settings.h
#define T3_STORE_SETTINGS_COPY 72u  // the same
#define T3_STORE_SETTINGS_SIZE 26u  // with its CRC
#define T3_STORE_CALIBRATION 104u       // see t3_calibration.h
#define T3_STORE_CALIBRATION_COPY 192u  // the same
#define T3_STORE_CALIBRATION_SIZE 85u   // with its CRC
#define T3_STORE_LOG 288u  // see t3_log.h: entries of 16 bytes
#define T3_STORE_LOG_ENTRIES 16u
#define T3_STORE_LOG_SIZE 16u  // of an entry, with its CRC
#define T3_STORE_END 544u
#define T3_STORE_RECORD_LIMIT 86u  // bytes of a record with its CRC

enum t3_record { T3_RECORD_BLANK, T3_RECORD_DAMAGED, T3_RECORD_GOOD };

// `size` is without the CRC.
enum t3_record t3_store_read(const struct t3_port *port, uint16_t address, uint8_t *data,
                             uint8_t size);
void t3_store_write(const struct t3_port *port, uint16_t address, const uint8_t *data,
                    uint8_t size);
// Return whether the cells of an area hold what was written; if they do not, their content is from now
// on what was written: else a cell that is worn out would be written over and over again.
bool t3_store_verify(const struct t3_port *port, const struct t3_console_port *console,
                     uint16_t address, uint8_t size);
// Erase a record.
void t3_store_erase(const struct t3_port *port, uint16_t address, uint8_t size);

#endif
