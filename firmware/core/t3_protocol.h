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

// Protocol 2 byte by byte: radio payloads, and the frames of the serial line around them. All
// numbers are little endian. docs/radio.md has the byte tables.
#ifndef T3_PROTOCOL_H
#define T3_PROTOCOL_H

#include <stdbool.h>
#include <stdint.h>

#define T3_VERSION 2u
#define T3_FIRMWARE_MAJOR 2u
#define T3_FIRMWARE_MINOR 1u
// Set by the Makefile: a digest of the sources and of the build settings.
#ifndef T3_BUILD
#define T3_BUILD 0
#endif

#define T3_RADIO_LIMIT 32u  // bytes: maximum of the chip; a larger width is an attack
#define T3_FRAME_LIMIT 78u  // bytes of a serial frame without CRC: a TX with two payloads has 68
#define T3_CRC_SIZE 2u
#define T3_WIRE_LIMIT (T3_FRAME_LIMIT + T3_CRC_SIZE + 2u)  // COBS adds one byte and the end one
#define T3_TAG_SIZE 8u
#define T3_NONCE_SIZE 8u

// -- radio payloads ------------------------------------------------------------------------------

// Kinds, host to robot.
enum { T3_CMD = 1, T3_PARAM_GET, T3_PARAM_SET, T3_HELLO, T3_POLL, T3_ACTION };
// Kinds, robot to host.
enum { T3_STATE = 1, T3_PARAM, T3_INFO, T3_ACK, T3_AUX };

#define T3_CMD_SIZE 14u
#define T3_STATE_SIZE 32u
#define T3_PARAM_SIZE 17u
#define T3_INFO_SIZE 24u  // plus a nonce from a keyed robot
#define T3_ACK_SIZE 5u
#define T3_AUX_SIZE 32u

// Flags of a CMD.
#define T3_FLAG_ENABLE 1u
#define T3_FLAG_ESTOP 2u
#define T3_FLAG_ESTOP_CLEAR 4u

// Status bits of STATE, INFO and AUX.
#define T3_STATUS_ENABLED 1u
#define T3_STATUS_MOVING 2u
#define T3_STATUS_ESTOP 4u
#define T3_STATUS_TTL_EXPIRED 8u
#define T3_STATUS_IMU_FAULT 16u
#define T3_STATUS_LOW_BATTERY 32u
#define T3_STATUS_NO_SESSION 64u
#define T3_STATUS_LIMITED 128u

// Kinds of state that a POLL requests.
enum { T3_POLL_STATE, T3_POLL_AUX, T3_POLL_INFO };
// Verbs of an ACTION.
enum { T3_RESET_ODOMETRY = 1, T3_CLEAR_COUNTERS };
// Results in PARAM, ACK, KEY, SETTINGS and RECORD; the last one not in PARAM and ACK.
enum { T3_RC_OK, T3_RC_UNKNOWN, T3_RC_RANGE, T3_RC_READ_ONLY, T3_RC_BUSY, T3_RC_FAILED };

#define T3_AGE_NONE 0xFFFFu
#define T3_RANGES 8u

// Why the robot refuses a payload, in INFO and AUX.
enum t3_refusal {
    T3_ADMITTED,
    T3_REFUSED_VERSION,   // another version of the protocol
    T3_REFUSED_FORM,      // unknown kind, wrong length, or a value out of range
    T3_REFUSED_SETTINGS,  // HELLO: the robot has no valid settings
    T3_REFUSED_KEY,       // HELLO: the key of the robot is damaged, or being written
    T3_REFUSED_UNSIGNED,  // no tag, but the robot has a key
    T3_REFUSED_SIGNED,    // a tag, but the robot has no key
    T3_REFUSED_SESSION,   // no session, or not the current one
    T3_REFUSED_TAG,       // bad tag, or a replay
    T3_REFUSED_SEQUENCE,  // CMD: repeated, or overtaken by a newer one
    T3_REFUSED_STALE      // CMD: its echo is too old
};
#define T3_HEADER_SIZE 3u  // bytes that every payload begins with: version and kind, session, seq
// A radio payload from the host. The valid fields depend on the kind.
struct t3_packet {
    uint8_t kind, session, seq;
    uint8_t what;  // CMD, HELLO: flags; PARAM_*: id; POLL: what; ACTION: verb
    uint8_t ttl;   // 10 ms
    int16_t left, right;  // mrad/s
    int32_t value;
    uint32_t echo_us;  // CMD: robot time of the newest STATE that the host has
    uint32_t host_us;  // of a signed frame
    const uint8_t *nonce;  // a signed HELLO's, else NULL
    const uint8_t *tag;    // after the signed bytes; NULL if there is none
};

// Decode a payload completely or not at all: T3_ADMITTED, T3_REFUSED_VERSION or T3_REFUSED_FORM.
enum t3_refusal t3_decode(const uint8_t *data, uint8_t size, struct t3_packet *packet);
// Return whether a CMD of any version requests an emergency stop, even if it is otherwise invalid:
// stopping is always allowed.
bool t3_asks_to_stop(const uint8_t *data, uint8_t size);
// Return whether a payload of another version asks for the identity of the robot: a HELLO, or a POLL
// for INFO.
bool t3_asks_for_identity(const uint8_t *data, uint8_t size);
struct t3_state {
    uint8_t session, seq, status;
    uint32_t time_us;
    int32_t left, right;  // microsteps
    int16_t gyro_z, accel_x, accel_y;
    uint16_t age;  // 10 us
    uint8_t ranges[T3_RANGES];
};

struct t3_param {
    uint8_t session, seq, id, rc;
    int32_t value, low, high;
};

struct t3_info {
    uint8_t version;  // of the request, in byte 0
    uint8_t session, seq, protocol, major, minor, reset_cause, parameters;
    uint16_t steps_per_rev, microsteps;
    uint8_t refusal;   // enum t3_refusal, of the newest refused payload
    uint8_t settings;  // state of the record
    uint8_t channel;
    const uint8_t *address;  // 5 bytes
    uint32_t build;
    const uint8_t *nonce;  // NULL from a robot without a key
};

// Counters of the robot, in the order of AUX, modulo 2**16.
struct t3_counters {
    uint16_t received, duplicates, bad_session, stale, expired, bad_version, malformed;
};

struct t3_aux {
    uint8_t session, seq, status;
    uint16_t battery;  // mV
    int16_t temperature, accel_z, gyro_x, gyro_y;
    struct t3_counters counters;
    uint8_t refusal;                  // as in INFO
    uint8_t refused[T3_HEADER_SIZE];  // first bytes of the newest refused payload
};

// Each writes one payload and returns its size.
uint8_t t3_encode_state(const struct t3_state *state, uint8_t *to);
uint8_t t3_encode_param(const struct t3_param *param, uint8_t *to);
uint8_t t3_encode_info(const struct t3_info *info, uint8_t *to);
uint8_t t3_encode_ack(uint8_t session, uint8_t seq, uint8_t verb, uint8_t rc, uint8_t *to);
uint8_t t3_encode_aux(const struct t3_aux *aux, uint8_t *to);

// -- serial line: COBS( frame | CRC-16 ), then a zero byte ---------------------------------------

// Frames from the host: TX and CFG to a dongle only, those from KEY on to a robot only.
enum {
    T3_TX = 0x01,
    T3_CFG = 0x02,
    T3_PING = 0x03,
    T3_KEY = 0x04,
    T3_RECORD = 0x06,
    T3_STORE = 0x07,
    T3_SENSE = 0x08
};
// Frames to the host.
enum {
    T3_RESULT = 0x81,
    T3_CFG_IS = 0x82,
    T3_PONG = 0x83,
    T3_KEY_IS = 0x84,
    T3_RECORD_IS = 0x86,
    T3_SENSE_IS = 0x88,
    T3_ERR = 0x8F
};
// Codes of ERR, whose argument is the first byte of the frame, or for BUSY its id.
enum { T3_ERR_UNKNOWN = 1, T3_ERR_MALFORMED, T3_ERR_BUSY };

#define T3_PING_SIZE 6u
#define T3_PONG_SIZE 32u

// Status of a board in PONG, after the id and echo of the PING.
struct t3_pong {
    uint32_t time_us;
    bool chip_ok;
    uint16_t crc_errors, frame_errors, overruns;
    uint8_t reset_cause;
    uint8_t settings;  // state of the robot's record; 0 from a dongle
    uint8_t channel;
    const uint8_t *address;  // 5 bytes
};

// Write the reply to a PING of T3_PING_SIZE bytes; return its size.
uint8_t t3_encode_pong(const uint8_t *ping, const struct t3_pong *pong, uint8_t *to);

// CRC-16/IBM-3740, starting at 0xFFFF: 0x29B1 of "123456789".
uint16_t t3_crc16(const uint8_t *data, uint8_t size);

// Encode a frame of 1 to T3_FRAME_LIMIT bytes for the line; return the number of bytes (at most
// T3_WIRE_LIMIT), 0 if the size is out of bounds.
uint8_t t3_to_wire(const uint8_t *frame, uint8_t size, uint8_t *wire);

// Decodes frames from a byte stream; resynchronises at the next zero byte after any error.
struct t3_splitter {
    uint8_t frame[T3_FRAME_LIMIT + T3_CRC_SIZE];
    uint8_t size;  // number of bytes in `frame`
    uint8_t left;  // bytes left in the run
    bool begun, bad;
    uint16_t frames;        // valid frames
    uint16_t crc_errors;    // well-formed, but with a wrong CRC
    uint16_t frame_errors;  // too long, too short, or invalid COBS
};

void t3_splitter_start(struct t3_splitter *splitter);
// Process a byte. If it completes a valid frame, return its size without CRC; the bytes are in `frame`
// until the next call. Otherwise return 0.
uint8_t t3_splitter_byte(struct t3_splitter *splitter, uint8_t byte);

#endif
