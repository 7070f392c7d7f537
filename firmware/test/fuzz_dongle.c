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

// Well-framed nonsense and a radio that answers anything: the dongle neither faults nor falls
// silent.

#include <stdbool.h>
#include <stdio.h>
#include <string.h>

#include "fuzz.h"
#include "t3_dongle.h"
#include "t3_host.h"

#define FRAMES 500000ul

static uint8_t nonsense(uint8_t *frame)
{
    const uint8_t size = (uint8_t)(1 + fuzz_below(T3_FRAME_LIMIT));
    for (uint8_t i = 0; i < size; i++)
        frame[i] = fuzz_byte();
    if (fuzz_below(10))
        frame[0] = (uint8_t)(1 + fuzz_below(3));
    if (frame[0] == T3_TX && size > 3 && fuzz_below(3))
        frame[3] = (uint8_t)fuzz_below(35);
    // Of a size and with values that are right more often than chance makes them.
    if (frame[0] == T3_CFG && size >= 12 && fuzz_below(2)) {
        static const uint8_t RIGHT[] = {82, 1, 3, 1, 3};
        memcpy(frame + 2, RIGHT, sizeof RIGHT);
        return 12;
    }
    return frame[0] == T3_PING && fuzz_below(2) ? (uint8_t)6 : size;
}

static void answer(struct t3_host_dongle *dongle)
{
    uint8_t sent[T3_RADIO_LIMIT], reply[64];
    for (uint8_t i = 0; i < sizeof reply; i++)
        reply[i] = fuzz_byte();
    // A chip may answer twice, unasked, or claim any size; now and then it dies.
    if (t3_host_dongle_sent(dongle, sent) ? fuzz_below(100) != 0 : fuzz_below(10) == 0)
        t3_host_dongle_answer(dongle, fuzz_below(3) != 0, fuzz_byte(), reply,
                              (uint8_t)fuzz_below(fuzz_below(5) ? 33 : 65));
}

int main(void)
{
    struct t3_host_dongle *dongle = t3_host_dongle_new(1);
    CHECK(dongle);
    struct t3_splitter splitter;
    t3_splitter_start(&splitter);
    uint64_t replies = 0, results = 0;
    for (uint64_t i = 0; i < FRAMES; i++) {
        uint8_t frame[T3_FRAME_LIMIT], wire[T3_WIRE_LIMIT], out[4096];
        const uint8_t size = nonsense(frame);
        const uint8_t length = t3_to_wire(frame, size, wire);
        t3_host_dongle_bytes(dongle, wire, length);
        for (int turn = 0; turn < 3; turn++) {
            answer(dongle);
            t3_host_dongle_run(dongle, fuzz_below(fuzz_below(1000) ? 3000 : 300000));
        }
        const uint32_t written = t3_host_dongle_take(dongle, out, sizeof out);
        for (uint32_t j = 0; j < written; j++) {
            const uint8_t got = t3_splitter_byte(&splitter, out[j]);
            if (!got)
                continue;
            replies++;
            results += splitter.frame[0] == T3_RESULT;
            CHECK(splitter.frame[0] & 0x80);
            CHECK(splitter.frame[0] != T3_RESULT || got <= 8 + T3_RADIO_LIMIT);
        }
    }
    printf("dongle: %lu frames, %llu replies, %llu results\n", FRAMES,
           (unsigned long long)replies, (unsigned long long)results);
    CHECK(splitter.crc_errors == 0 && splitter.frame_errors == 0);
    // Every frame is answered once; the last transaction may still be under way.
    CHECK(replies >= FRAMES - 1 && replies <= FRAMES);
    CHECK(results > FRAMES / 20);
    t3_host_dongle_free(dongle);
    return 0;
}
