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

// Little-endian numbers in byte buffers. Written out byte by byte: the wire's order does not
// depend on the machine, and an AVR's int has 16 bits, so every shift happens in a wide type.
#ifndef T3_BYTES_H
#define T3_BYTES_H

#include <stdint.h>

static inline uint16_t t3_get16(const uint8_t *from)
{
    return (uint16_t)((uint16_t)from[0] | (uint16_t)((uint16_t)from[1] << 8));
}

static inline uint32_t t3_get32(const uint8_t *from)
{
    return (uint32_t)t3_get16(from) | (uint32_t)t3_get16(from + 2) << 16;
}

// Each put returns the position after the written bytes, so that a frame is written field by field.
static inline uint8_t *t3_put8(uint8_t *to, uint8_t value)
{
    *to = value;
    return to + 1;
}

static inline uint8_t *t3_put16(uint8_t *to, uint16_t value)
{
    to[0] = (uint8_t)value;
    to[1] = (uint8_t)(value >> 8);
    return to + 2;
}

static inline uint8_t *t3_put32(uint8_t *to, uint32_t value)
{
    return t3_put16(t3_put16(to, (uint16_t)value), (uint16_t)(value >> 16));
}

// The conversion of an unsigned value above the signed range is left to the compiler by C99; these
// functions define it.
static inline int16_t t3_signed16(uint16_t value)
{
    return value <= INT16_MAX ? (int16_t)value : (int16_t)(-1 - (int16_t)(UINT16_MAX - value));
}

static inline int32_t t3_signed32(uint32_t value)
{
    return value <= INT32_MAX ? (int32_t)value : -1 - (int32_t)(UINT32_MAX - value);
}

// Return a - b on a clock that wraps, us.
static inline int32_t t3_later_by(uint32_t a, uint32_t b)
{
    return t3_signed32(a - b);
}

#endif
