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
#include "t3_siphash.h"

#include "t3_bytes.h"
#include "t3_rotate.h"

struct sip {
    uint64_t a, b, c, d;  // v0 to v3 of the paper
};

static uint64_t get64(const uint8_t *from)
{
    return t3_get32(from) | (uint64_t)t3_get32(from + 4) << 32;
}

static void rounds(struct sip *sip, uint8_t count)
{
    struct sip v = *sip;
    while (count--) {
        v.a += v.b;
        v.b = t3_rotate(v.b, 13) ^ v.a;
        v.a = t3_rotate(v.a, 32);
        v.c += v.d;
        v.d = t3_rotate(v.d, 16) ^ v.c;
        v.a += v.d;
        v.d = t3_rotate(v.d, 21) ^ v.a;
        v.c += v.b;
        v.b = t3_rotate(v.b, 17) ^ v.c;
        v.c = t3_rotate(v.c, 32);
    }
    *sip = v;
}

static void absorb(struct sip *sip, const uint8_t *eight)
{
    const uint64_t word = get64(eight);
    sip->d ^= word;
    rounds(sip, 2);
    sip->a ^= word;
}

void t3_siphash(const uint8_t key[T3_KEY_SIZE], const uint8_t *data, uint8_t size, uint8_t out[8])
{
    const uint64_t low = get64(key), high = get64(key + 8);
    // The paper's start: "somepseudorandomlygeneratedbytes".
    struct sip sip = {
        low ^ UINT64_C(0x736F6D6570736575),
        high ^ UINT64_C(0x646F72616E646F6D),
        low ^ UINT64_C(0x6C7967656E657261),
        high ^ UINT64_C(0x7465646279746573),
    };
    uint8_t left = size;
    for (; left >= 8; left = (uint8_t)(left - 8), data += 8)
        absorb(&sip, data);
    uint8_t last[8] = {0};
    last[7] = size;
    for (uint8_t i = 0; i < left; i++)
        last[i] = data[i];
    absorb(&sip, last);
    sip.c ^= 0xFF;
    rounds(&sip, 4);
    const uint64_t hash = sip.a ^ sip.b ^ sip.c ^ sip.d;
    t3_put32(t3_put32(out, (uint32_t)hash), (uint32_t)(hash >> 32));
}
