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
#include <string.h>

#include "nrf24_inside.h"

static uint32_t cycles_per_bit(const struct nrf24 *radio)
{
    const uint8_t setup = radio->registers[RF_SETUP];
    return setup & 0x20 ? 4 * CYCLES_PER_US : setup & 0x08 ? CYCLES_PER_US / 2 : CYCLES_PER_US;
}

// Preamble, address, control field, payload, CRC.
static uint64_t air_cycles(const struct nrf24 *radio, uint8_t width)
{
    return ((1u + 5u + width + 2u) * 8u + 9u) * cycles_per_bit(radio);
}

static uint64_t retry_cycles(const struct nrf24 *radio)
{
    return ((radio->registers[SETUP_RETR] >> 4) + 1u) * 250u * CYCLES_PER_US;
}

// xorshift64*, G. Marsaglia's generator with S. Vigna's multiplier.
static double draw(struct radio_channel *channel)
{
    channel->random ^= channel->random >> 12;
    channel->random ^= channel->random << 25;
    channel->random ^= channel->random >> 27;
    return (double)(channel->random * UINT64_C(2685821657736338717) >> 11) * 0x1p-53;
}

static bool receives(const struct nrf24 *from, const struct nrf24 *to, uint64_t begun_at)
{
    const uint8_t *a = from->registers, *b = to->registers;
    return nrf24_awake(to, begun_at) && to->ce && b[CONFIG] & PRIM_RX && begun_at >= to->listening_at &&
           begun_at >= to->ack_until && a[RF_CH] == b[RF_CH] &&
           cycles_per_bit(from) == cycles_per_bit(to) &&
           (a[CONFIG] & 0x0C) == (b[CONFIG] & 0x0C) && a[EN_AA] & b[EN_AA] & 1 &&
           b[EN_RXADDR] & 1 && a[DYNPD] & b[DYNPD] & 1 && a[FEATURE] & b[FEATURE] & 4 &&
           !memcmp(from->address[2], to->address[0], 5);
}

// End of a packet at the receiver: return whether it is acknowledged, and begin the acknowledgement.
static bool arrive(const struct nrf24 *from, struct nrf24 *to, uint64_t now)
{
    const struct nrf24_packet *packet = &from->tx.packets[0];
    const bool again = to->received_any && to->last_pid == from->pid &&
                       to->last_packet.width == packet->width &&
                       !memcmp(to->last_packet.data, packet->data, packet->width);
    if (again) {
        to->duplicates++;
    } else {
        if (to->rx.count == NRF24_DEPTH) {
            to->faults.rx_overflows++;
            return false;
        }
        // A new packet confirms the reception of the previous acknowledgement.
        if (to->ack_unconfirmed) {
            nrf24_drop(&to->tx);
            to->ack_unconfirmed = false;
            nrf24_flag(to, TX_DS);
        }
        to->received_any = true;
        to->last_pid = from->pid;
        to->last_packet = *packet;
        to->rx.packets[to->rx.count++] = *packet;
        to->received++;
        nrf24_flag(to, RX_DR);
    }
    const bool carries = to->registers[FEATURE] & 2 && to->tx.count;
    to->ack_unconfirmed = carries;
    to->ack_damaged = false;
    to->ack_until = now + SETTLE_CYCLES + air_cycles(to, carries ? to->tx.packets[0].width : 0);
    return true;
}

static void end_packet(struct radio_channel *channel, struct nrf24 *from, struct nrf24 *to)
{
    const uint64_t now = from->next_at;
    const bool down = draw(channel) >= channel->loss[0] && !channel->jammed;
    const bool up = draw(channel) >= channel->loss[1] && !channel->jammed;
    from->sent_at = now;
    from->attempts++;
    from->phase = NRF24_NO_ACK;
    from->next_at = now + retry_cycles(from);
    const uint64_t begun_at = now - air_cycles(from, from->tx.packets[0].width);
    if (!down || !receives(from, to, begun_at) || !arrive(from, to, now))
        return;
    from->ack.width = 0;
    if (to->ack_unconfirmed)
        from->ack = to->tx.packets[0];
    // An acknowledgement longer than ARD collides with the retransmission.
    if (!up || to->ack_until > from->next_at || memcmp(from->address[0], to->address[0], 5))
        return;
    from->phase = NRF24_ACK_COMES;
    from->next_at = to->ack_until;
}

static void end_ack(struct nrf24 *from, struct nrf24 *to)
{
    if (to->ack_damaged) {
        from->phase = NRF24_NO_ACK;
        from->next_at = from->sent_at + retry_cycles(from);
        return;
    }
    const uint64_t now = from->next_at;
    from->phase = NRF24_QUIET;
    nrf24_drop(&from->tx);
    from->sent++;
    uint8_t flags = TX_DS;
    if (from->ack.width && from->rx.count < NRF24_DEPTH) {
        from->rx.packets[from->rx.count++] = from->ack;
        flags |= RX_DR;
    }
    nrf24_flag(from, flags);
    nrf24_begin(from, now);
}

static void repeat(struct nrf24 *from)
{
    const uint64_t now = from->next_at;
    if (from->repeats < (from->registers[SETUP_RETR] & 0x0F)) {
        from->repeats++;
        from->registers[OBSERVE_TX]++;
        from->phase = NRF24_ON_AIR;
        from->next_at = now + air_cycles(from, from->tx.packets[0].width);
        return;
    }
    from->phase = NRF24_QUIET;
    if (from->registers[OBSERVE_TX] < 0xF0)
        from->registers[OBSERVE_TX] += 0x10;
    nrf24_flag(from, MAX_RT);
}

static void step(struct radio_channel *channel, struct nrf24 *from, struct nrf24 *to)
{
    if (!from->powered || !from->tx.count) {
        from->phase = NRF24_QUIET;  // flushed during transmission
        return;
    }
    switch (from->phase) {
    case NRF24_SETTLING:
        from->phase = NRF24_ON_AIR;
        from->next_at += air_cycles(from, from->tx.packets[0].width);
        return;
    case NRF24_ON_AIR:
        end_packet(channel, from, to);
        return;
    case NRF24_ACK_COMES:
        end_ack(from, to);
        return;
    case NRF24_NO_ACK:
        repeat(from);
        return;
    case NRF24_QUIET:
        return;
    }
}

void radio_channel_run(struct radio_channel *channel, uint64_t now)
{
    for (int i = 0; i < 2; i++) {
        struct nrf24 *from = channel->radios[i], *to = channel->radios[1 - i];
        while (from->phase != NRF24_QUIET && from->next_at <= now)
            step(channel, from, to);
    }
}
