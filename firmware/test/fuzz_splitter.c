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

// Random and damaged bytes through the frame decoder: no fault, no more frames than the CRC passes.

#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "fuzz.h"
#include "t3_protocol.h"

#define RANDOM_BYTES 20000000ul
#define DAMAGED_FRAMES 200000ul

struct counts {
    uint64_t frames, crc_errors, frame_errors;
};

// The counters have 16 bits: add up what each byte changed.
static uint8_t feed(struct t3_splitter *splitter, uint8_t byte, struct counts *counts)
{
    const struct t3_splitter before = *splitter;
    const uint8_t size = t3_splitter_byte(splitter, byte);
    CHECK(size <= T3_FRAME_LIMIT);
    CHECK(splitter->size <= sizeof splitter->frame);
    counts->frames += (uint16_t)(splitter->frames - before.frames);
    counts->crc_errors += (uint16_t)(splitter->crc_errors - before.crc_errors);
    counts->frame_errors += (uint16_t)(splitter->frame_errors - before.frame_errors);
    return size;
}

// One in 65536 passes a CRC of 16 bits by chance; five standard deviations and a few more are none.
static void check_accepted(const char *what, const struct counts *counts)
{
    const double expected = (double)(counts->frames + counts->crc_errors) / 65536.0;
    printf("splitter, %s: %llu accepted (expected %.2f), %llu CRC errors, %llu frame errors\n",
           what, (unsigned long long)counts->frames, expected,
           (unsigned long long)counts->crc_errors, (unsigned long long)counts->frame_errors);
    CHECK((double)counts->frames <= expected + 5.0 * sqrt(expected) + 3.0);
}

// `zeros`: how many of 256 bytes are made zero besides, so that frames of all lengths end.
static void random_bytes(uint32_t zeros)
{
    struct t3_splitter splitter;
    struct counts counts = {0, 0, 0};
    t3_splitter_start(&splitter);
    for (uint64_t i = 0; i < RANDOM_BYTES; i++) {
        uint8_t byte = fuzz_byte();
        // Small numbers are run lengths that stay inside a frame; without, nearly all is no COBS.
        if (zeros && fuzz_below(4) == 0)
            byte &= 0x07;
        feed(&splitter, fuzz_below(256) < zeros ? 0 : byte, &counts);
    }
    check_accepted(zeros ? "shaped bytes" : "random bytes", &counts);
    CHECK(!zeros || counts.crc_errors > 1000);
}

static uint8_t damage(uint8_t *wire, uint8_t size)
{
    const uint8_t at = (uint8_t)fuzz_below(size);
    switch (fuzz_below(3)) {
    case 0:  // flip a bit
        wire[at] = (uint8_t)(wire[at] ^ 1u << fuzz_below(8));
        return size;
    case 1:  // lose a byte
        memmove(wire + at, wire + at + 1, (size_t)(size - at - 1));
        return (uint8_t)(size - 1);
    default:  // catch one too many
        memmove(wire + at + 1, wire + at, (size_t)(size - at));
        wire[at] = fuzz_byte();
        return (uint8_t)(size + 1);
    }
}

// After whatever damage, the next frame but one is always understood.
static void damaged_frames(void)
{
    struct t3_splitter splitter;
    struct counts counts = {0, 0, 0};
    uint64_t wrong = 0;
    t3_splitter_start(&splitter);
    for (uint64_t i = 0; i < DAMAGED_FRAMES; i++) {
        uint8_t frame[T3_FRAME_LIMIT], wire[T3_WIRE_LIMIT + 1];
        const uint8_t size = (uint8_t)(1 + fuzz_below(T3_FRAME_LIMIT));
        for (uint8_t j = 0; j < size; j++)
            frame[j] = fuzz_below(3) ? fuzz_byte() : 0;
        uint8_t length = t3_to_wire(frame, size, wire);
        const bool damaged = i % 3 == 0;
        if (damaged)
            length = damage(wire, length);
        bool found = false;
        for (uint8_t j = 0; j < length; j++) {
            const uint8_t got = feed(&splitter, wire[j], &counts);
            if (!got)
                continue;
            if (got == size && !memcmp(splitter.frame, frame, size))
                found = true;
            else
                wrong++;
        }
        if (i % 3 == 2)
            CHECK(found);
    }
    printf("splitter, damaged frames: %llu of %llu good, %llu wrong\n",
           (unsigned long long)counts.frames, (unsigned long long)DAMAGED_FRAMES,
           (unsigned long long)wrong);
    // 66667 damaged, and one in 65536 of them
    CHECK(wrong <= 8);
}

int main(void)
{
    random_bytes(0);
    random_bytes(8);
    damaged_frames();
    return 0;
}
