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

// Exhaustive search over the states of a session: every order of what a host, the air, a stranger, the
// button, the battery, a reset and the time may do, until no new state is found, or up to a number of
// events, the argument.
//
// The host makes frames; the air keeps the newest of them and delivers each at any time, any number of
// times, in any order, or not at all. The truth beside the robot identifies frames by the order in
// which they were made, not by their bytes. It checks, after every millisecond and every frame:
//  - nothing moves without a session, after an emergency stop, with an empty battery, or without a
//    command of this session;
//  - no command is followed longer than its TTL, or later than its TTL and T3_ECHO_AGE_US after the
//    host made it (without a key: unless the robot was reset and HELLO replayed);
//  - with a key no command and no request is executed twice, whatever is replayed; without one, no
//    sequence number is executed twice within a session;
//  - an emergency stop remains until the host of the session clears it, and not while the button is
//    pressed;
//  - a command of the host that is new, in time and in session is followed.
//
// States are equal if they differ only in what cannot matter: absolute times and numbers, keys, nonces,
// telemetry. The half hour of silence that ends a session is an event; shorter waits do not add up to it.
// Older frames than T3_SLOTS are forgotten; of commands that were never delivered no more
// than SEQ_LIMIT are distinguished.

#include <stdbool.h>
#include <stdio.h>
#include <string.h>

#include "fuzz.h"
#include "t3_bytes.h"
#include "t3_console.h"
#include "t3_robot.h"

#ifndef T3_SLOTS
#define T3_SLOTS 2
#endif
#define SEQ_LIMIT 3
#define STEP_US UINT32_C(1000)  // of the main loop
#define WAIT_US UINT32_C(50000)
#define AGE_LIMIT_US UINT32_C(200000)  // beyond it, ages no longer matter
#define TTL 10u                        // 10 ms
#define TTL_US (TTL * UINT32_C(10000))
#define SPEED 300  // mrad/s: the ramp ends within one wait
#define RAMP_US UINT32_C(12000)
#define FULL 600u  // counts of the converter
#define EMPTY 400u
#define PATH_LIMIT 100

static const uint8_t KEY[T3_KEY_SIZE] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};

enum kind { NOTHING, HELLO, DRIVE, STOP, CLEAR, ESTOP, SET };

struct frame {
    enum kind kind;
    uint8_t data[T3_RADIO_LIMIT], size;
    uint8_t seq;
    uint32_t made_us, order;  // the robot's time, and the number of the frame
    uint32_t echo_us;         // the same time, as it stands in the frame
    bool rebooted;            // the robot has since: its clock has started anew
    uint32_t session;         // number of the session it was made in, counted by the truth
    uint8_t key[T3_KEY_SIZE];  // that signed it
    bool executed;
};

// State of the host.
struct host {
    uint8_t id, seq;
    uint8_t key[T3_KEY_SIZE];
    uint32_t orders, hello;  // frames made; the newest HELLO
    uint32_t session;        // 0: HELLO has not been answered
    uint8_t newest;          // slot
};

struct truth {
    uint32_t sessions, session;  // begun since the start; the current one, 0: none
    uint32_t hello;              // that began it
    uint32_t admitted;           // order of the newest signed frame
    bool seq_known;
    uint8_t seq;
    bool latched;
    bool moving;           // a command to move is followed
    uint32_t until_us;     // for so long
    uint32_t stopped_us;   // end of the last motion
};

struct world {
    struct t3_robot robot;
    uint8_t eeprom[T3_STORE_END];
    uint32_t now_us;
    bool pressed;
    uint16_t supply;
    struct host host;
    struct truth truth;
    struct frame slots[T3_SLOTS];
    uint8_t path[PATH_LIMIT], steps;  // the actions so far
};

static struct world world;
static bool keyed, finished;

// -- port ----------------------------------------------------------------------------------------

static uint32_t time_us(void *context)
{
    (void)context;
    return world.now_us;
}

static void load_ack(void *context, const uint8_t *payload, uint8_t size)
{
    (void)context, (void)payload, (void)size;
}

static void drivers(void *context, bool on)
{
    (void)context, (void)on;
}

static bool estop_pressed(void *context)
{
    (void)context;
    return world.pressed;
}

static bool imu(void *context, struct t3_imu *sample)
{
    (void)context, (void)sample;
    return false;
}

static uint16_t adc(void *context, uint8_t channel)
{
    (void)context;
    return channel == T3_ADC_BATTERY ? world.supply : T3_ADC_NOT_MEASURED;
}

static void eeprom_read(void *context, uint16_t address, uint8_t *data, uint8_t size)
{
    (void)context;
    memcpy(data, world.eeprom + address, size);
}

static void eeprom_write(void *context, uint16_t address, const uint8_t *data, uint8_t size)
{
    (void)context;
    memcpy(world.eeprom + address, data, size);
}

static uint32_t noise(void *context)
{
    (void)context;
    return 0;
}

static void nothing(void *context)
{
    (void)context;
}

static bool settled(void *context)
{
    (void)context;
    return true;
}

static const struct t3_port PORT = {
    0,   time_us,     load_ack,     drivers, estop_pressed, imu,
    adc, eeprom_read, eeprom_write, noise,   nothing,       nothing,
};
static const struct t3_console_port CONSOLE = {
    .eeprom_settled = settled,
    .eeprom_cells = eeprom_read,
};

// -- time ----------------------------------------------------------------------------------------

static bool wheels_aim(void)
{
    return world.robot.ramp.target[T3_LEFT] || world.robot.ramp.target[T3_RIGHT];
}

static void check_motion(void)
{
    struct truth *truth = &world.truth;
    const struct t3_robot *robot = &world.robot;
    // The main loop notices the end of a TTL with its next pass.
    if (truth->moving && t3_later_by(world.now_us, truth->until_us) >= 0) {
        truth->moving = false;
        truth->stopped_us = world.now_us;
    }
    CHECK(wheels_aim() == truth->moving);
    CHECK(!truth->moving || (truth->session && !truth->latched && !robot->flat));
    CHECK(robot->estop == truth->latched);
    CHECK(!robot->session.id == !truth->session);
    if (t3_ramp_moving(&robot->ramp))
        CHECK(truth->moving || world.now_us - truth->stopped_us <= RAMP_US);
}

static void pass(void)
{
    world.now_us += STEP_US;
    t3_robot_tick(&world.robot);
    struct truth *truth = &world.truth;
    // The button latches after its debounce time; an empty battery disables.
    if (world.robot.pressed) {
        CHECK(world.pressed || truth->latched);
        truth->latched = true;
    }
    if ((truth->latched || world.robot.flat) && truth->moving) {
        truth->moving = false;
        truth->stopped_us = world.now_us;
    }
    check_motion();
}

static void wait(uint32_t us)
{
    for (; us; us -= STEP_US)
        pass();
}

static void silence(void)
{
    wait(AGE_LIMIT_US);
    world.now_us += T3_SESSION_SILENCE_US;
    world.truth.session = 0;
    pass();
}

static void boot(void)
{
    struct truth *truth = &world.truth;
    world.now_us = 0;
    t3_robot_boot(&world.robot, &PORT, 1, T3_SETTLE_US);
    truth->session = 0;
    truth->latched = truth->moving = false;
    for (int i = 0; i < T3_SLOTS; i++) {
        world.slots[i].made_us = 0u - AGE_LIMIT_US;
        world.slots[i].rebooted = true;
    }
    pass();
}

// -- frames --------------------------------------------------------------------------------------

static void sign(struct frame *frame, const uint8_t *key, uint8_t *end)
{
    uint8_t text[T3_RADIO_LIMIT + 4] = {0};
    end = t3_put32(end, frame->order);  // the clock of the host
    const uint8_t size = (uint8_t)(end - frame->data);
    memcpy(text, frame->data, size);  // then the epoch, 0
    t3_siphash(key, text, (uint8_t)(size + 4), end);
    frame->size = (uint8_t)(size + T3_TAG_SIZE);
}

static void make_hello(struct frame *frame)
{
    struct host *host = &world.host;
    host->id = (uint8_t)(host->id % 255 + 1);
    host->hello = frame->order;
    host->session = 0;
    host->seq = 0;
    uint8_t *to = t3_put8(frame->data, T3_VERSION << 4 | T3_HELLO);
    to = t3_put8(to, host->id);
    to = t3_put8(to, 0);
    to = t3_put8(to, keyed);
    frame->size = (uint8_t)(to - frame->data);
    if (!keyed)
        return;
    to = t3_put32(to, frame->order);
    to = t3_put32(to, frame->order);  // nonce
    to = t3_put32(to, 0);
    uint8_t text[1 + 16] = {1};
    memcpy(text + 1, frame->data, 16);
    t3_siphash(KEY, text, sizeof text, to);
    frame->size = 24;
}

// A request, which has no sequence number: PARAM_SET of a value that changes nothing.
static void make_set(struct frame *frame)
{
    uint8_t *to = t3_put8(frame->data, T3_VERSION << 4 | T3_PARAM_SET);
    to = t3_put8(to, world.host.id);
    to = t3_put8(to, 0);
    to = t3_put8(to, T3_IDLE_OFF);
    to = t3_put32(to, 0);
    frame->size = (uint8_t)(to - frame->data);
    if (keyed)
        sign(frame, world.host.key, to);
}

static void make(enum kind kind)
{
    struct host *host = &world.host;
    host->newest = (uint8_t)((host->newest + 1) % T3_SLOTS);
    struct frame *frame = &world.slots[host->newest];
    memset(frame, 0, sizeof *frame);
    frame->kind = kind;
    frame->made_us = frame->echo_us = world.now_us;
    frame->order = ++host->orders;
    if (kind == HELLO) {
        make_hello(frame);
        return;
    }
    const uint8_t flags = kind == DRIVE   ? T3_FLAG_ENABLE
                          : kind == CLEAR ? T3_FLAG_ESTOP_CLEAR
                          : kind == ESTOP ? T3_FLAG_ESTOP
                                          : 0;
    const uint16_t speed = kind == DRIVE ? SPEED : 0;
    frame->session = host->session;
    memcpy(frame->key, host->key, sizeof frame->key);
    if (kind == SET) {
        make_set(frame);
        return;
    }
    frame->seq = ++host->seq;
    uint8_t *to = t3_put8(frame->data, T3_VERSION << 4 | T3_CMD);
    to = t3_put8(to, host->id);
    to = t3_put8(to, frame->seq);
    to = t3_put8(to, flags);
    to = t3_put8(to, TTL);
    to = t3_put8(to, 0);
    to = t3_put16(to, speed);
    to = t3_put16(to, speed);
    to = t3_put32(to, frame->echo_us);  // of the newest state that there may be
    frame->size = T3_CMD_SIZE;
    if (keyed)
        sign(frame, host->key, to);
}

static void hello_arrives(struct frame *frame, const struct t3_robot *before)
{
    struct truth *truth = &world.truth;
    struct host *host = &world.host;
    const bool repeated = keyed && truth->session && truth->hello == frame->order;
    if (!repeated) {
        truth->session = ++truth->sessions;
        truth->hello = truth->admitted = frame->order;
        truth->seq_known = false;
        if (truth->moving)
            truth->stopped_us = world.now_us;
        truth->moving = false;
    }
    CHECK(world.robot.session.id == frame->data[1]);
    CHECK(!repeated || !memcmp(&world.robot.session, &before->session, sizeof before->session));
    if (host->hello == frame->order) {  // INFO comes back
        host->session = truth->session;
        memcpy(host->key, world.robot.session.session_key, sizeof host->key);
    }
}

// Whether a CMD belongs to the session; it then counts for the order of the signed frames.
static bool in_session(const struct frame *frame)
{
    struct truth *truth = &world.truth;
    if (!truth->session)
        return false;
    if (!keyed)  // the number of the session is all there is
        return frame->data[1] == world.robot.session.id;
    if (frame->session != truth->session || frame->order <= truth->admitted)
        return false;
    truth->admitted = frame->order;
    return true;
}

static void command_arrives(struct frame *frame, const struct t3_robot *before)
{
    struct truth *truth = &world.truth;
    const struct t3_robot *robot = &world.robot;
    if (frame->kind == ESTOP)
        truth->latched = true;
    const bool admitted = in_session(frame);
    const bool newer =
        !truth->seq_known || (frame->seq != truth->seq && (uint8_t)(frame->seq - truth->seq) < 0x80);
    const uint32_t age_us = world.now_us - frame->echo_us;
    const bool in_time = age_us < T3_ECHO_AGE_US + TTL_US;
    const bool executed = robot->seq_known && (!before->seq_known || robot->seq != before->seq);
    CHECK(executed == (admitted && newer && in_time));
    if (executed) {
        CHECK(!keyed || !frame->executed);
        // Without a key, a replayed HELLO after a reset makes old echoes look new.
        CHECK((!keyed && frame->rebooted) || age_us == world.now_us - frame->made_us);
        CHECK(robot->seq == frame->seq);
        frame->executed = true;
        truth->seq_known = true;
        truth->seq = frame->seq;
        if (frame->kind == CLEAR && !world.pressed && !before->pressed)
            truth->latched = false;
    }
    const bool was_moving = truth->moving;
    if (executed && frame->kind == DRIVE && !truth->latched && !before->flat) {
        truth->moving = true;
        const uint32_t excess_us = age_us > T3_ECHO_AGE_US ? age_us - T3_ECHO_AGE_US : 0;
        truth->until_us = world.now_us + TTL_US - excess_us;
    } else if (executed || truth->latched || (admitted && newer && frame->kind != DRIVE)) {
        truth->moving = false;  // a wish to stand is never too late
    }
    if (was_moving && !truth->moving)
        truth->stopped_us = world.now_us;
}

static void set_arrives(struct frame *frame)
{
    const bool executed = world.robot.answer.kind == T3_PARAM;
    CHECK(executed == in_session(frame));
    CHECK(!executed || !keyed || !frame->executed);
    frame->executed = frame->executed || executed;
}

static void deliver(struct frame *frame)
{
    const struct t3_robot before = world.robot;
    t3_robot_packet(&world.robot, frame->data, frame->size, world.now_us);
    if (frame->kind == HELLO)
        hello_arrives(frame, &before);
    else if (frame->kind == SET)
        set_arrives(frame);
    else
        command_arrives(frame, &before);
    check_motion();
}

static void strange_stop(void)
{
    struct frame frame = {.kind = ESTOP, .size = T3_CMD_SIZE};
    frame.data[0] = T3_VERSION << 4 | T3_CMD;
    frame.data[3] = T3_FLAG_ESTOP;
    deliver(&frame);
}

// -- actions -------------------------------------------------------------------------------------

static void supply(uint16_t count)
{
    world.supply = count;
    wait(AGE_LIMIT_US);
    for (int i = 0; i < 50; i++) {  // at rest by now: nothing happens in between
        world.now_us += T3_BATTERY_PERIOD_US;
        pass();
    }
    CHECK(world.robot.flat == (count == EMPTY));
}

enum { FRAMES = 6, OTHERS = 8, ACTIONS = FRAMES + T3_SLOTS + OTHERS };

// The way to what went wrong.
static void explain(void)
{
    static const char *const FRAME_NAMES[] = {"HELLO", "drive", "stop", "clear", "ESTOP", "set"};
    static const char *const OTHER_NAMES[] = {"wait",    "wait long", "silence", "reset",
                                              "strange ESTOP", "button", "empty",   "full"};
    for (int i = 0; !finished && i < world.steps; i++) {
        const int action = world.path[i];
        if (action < FRAMES)
            fprintf(stderr, "make %s, ", FRAME_NAMES[action]);
        else if (action < FRAMES + T3_SLOTS)
            fprintf(stderr, "deliver %d, ", action - FRAMES);
        else
            fprintf(stderr, "%s, ", OTHER_NAMES[action - FRAMES - T3_SLOTS]);
    }
}

// Return whether the action was possible.
static bool act(int action)
{
    CHECK(world.steps < PATH_LIMIT);
    world.path[world.steps++] = (uint8_t)action;
    if (action < FRAMES) {
        make((enum kind)(HELLO + action));
        return true;
    }
    action -= FRAMES;
    if (action < T3_SLOTS) {
        if (world.slots[action].kind == NOTHING)
            return false;
        deliver(&world.slots[action]);
        return true;
    }
    switch (action - T3_SLOTS) {
    case 0:
        wait(WAIT_US);
        return true;
    case 1:
        wait(AGE_LIMIT_US);
        return true;
    case 2:
        silence();
        return true;
    case 3:
        boot();
        return true;
    case 4:
        strange_stop();
        return true;
    case 5:
        world.pressed = !world.pressed;
        return true;
    case 6:
        if (world.supply == EMPTY)
            return false;
        supply(EMPTY);
        return true;
    default:
        if (world.supply == FULL)
            return false;
        supply(FULL);
        return true;
    }
}

// -- states --------------------------------------------------------------------------------------

static uint64_t digest;

static void add(uint32_t value)
{
    // SplitMix64: G. L. Steele, D. Lea, C. H. Flood, Fast splittable pseudorandom number generators,
    // OOPSLA 2014; constants of D. Stafford.
    digest += 0x9E3779B97F4A7C15u + value;
    digest = (digest ^ digest >> 30) * 0xBF58476D1CE4E5B9u;
    digest = (digest ^ digest >> 27) * 0x94D049BB133111EBu;
    digest ^= digest >> 31;
}

static void add_age(uint32_t since_us)
{
    const uint32_t age_us = world.now_us - since_us;
    add(age_us < AGE_LIMIT_US ? age_us : AGE_LIMIT_US);
}

static void add_seq(uint8_t seq)
{
    const uint8_t behind = (uint8_t)(world.host.seq - seq);
    add(behind < SEQ_LIMIT ? behind : SEQ_LIMIT);
}

// Return a number that is equal for equal states.
static uint64_t identify(void)
{
    const struct t3_robot *robot = &world.robot;
    const struct truth *truth = &world.truth;
    const struct host *host = &world.host;
    digest = keyed;
    const uint8_t flags[] = {
        robot->enabled, robot->estop,     robot->expired,   robot->powered, robot->pressed,
        robot->flat,    robot->ttl_runs,  robot->seq_known, world.pressed,  world.supply == FULL,
        truth->moving,  truth->seq_known, truth->latched,   !truth->session,
    };
    for (unsigned i = 0; i < sizeof flags; i++)
        add(flags[i]);
    for (int i = 0; i < T3_WHEELS; i++) {
        add((uint32_t)robot->ramp.speed[i]);
        add((uint32_t)robot->ramp.target[i]);
    }
    if (robot->ttl_runs) {
        add_age(robot->ttl_from_us);
        add(robot->ttl_us);
    }
    if (robot->pressed != world.pressed)
        add_age(robot->button_us);
    if (robot->seq_known)
        add_seq(robot->seq);
    add(host->session == truth->session);
    add(!memcmp(host->key, robot->session.session_key, sizeof host->key));
    add(host->id == robot->session.id);
    add(host->hello == truth->hello);
    for (int i = 0; i < T3_SLOTS; i++) {
        const struct frame *frame = &world.slots[(host->newest + i) % T3_SLOTS];
        add(frame->kind);
        if (frame->kind == NOTHING)
            continue;
        add_age(frame->made_us);
        add_age(frame->echo_us);
        add(frame->rebooted);
        add_seq(frame->seq);
        add(frame->order > truth->admitted);
        add(frame->order > robot->session.last_us);
        add(!memcmp(frame->key, robot->session.session_key, sizeof frame->key));
        add(frame->order == truth->hello);
        add(frame->order == host->hello);
        add(frame->session == truth->session);
        add(frame->session == host->session);
        add(frame->data[1] == robot->session.id);
        add(frame->data[1] == host->id);
        add(frame->executed);
    }
    return digest ? digest : 1;
}

// -- search --------------------------------------------------------------------------------------

static uint64_t *seen;
static size_t seen_count, seen_room;

static bool is_new(uint64_t state)
{
    if (2 * seen_count >= seen_room) {
        uint64_t *old = seen;
        const size_t room = seen_room;
        seen_room = room ? 2 * room : 1u << 16;
        seen = calloc(seen_room, sizeof *seen);
        CHECK(seen);
        seen_count = 0;
        for (size_t i = 0; i < room; i++)
            if (old[i])
                is_new(old[i]);
        free(old);
    }
    size_t at = state & (seen_room - 1);
    while (seen[at] && seen[at] != state)
        at = (at + 1) & (seen_room - 1);
    if (seen[at])
        return false;
    seen[at] = state;
    seen_count++;
    return true;
}

struct layer {
    struct world *worlds;
    size_t count, room;
};

static void keep(struct layer *layer)
{
    if (layer->count == layer->room) {
        layer->room = layer->room ? 2 * layer->room : 1024;
        layer->worlds = realloc(layer->worlds, layer->room * sizeof *layer->worlds);
        CHECK(layer->worlds);
    }
    layer->worlds[layer->count++] = world;
}

static void start(void)
{
    memset(&world, 0, sizeof world);
    memset(world.eeprom, 0xFF, sizeof world.eeprom);
    world.supply = FULL;
    static const struct t3_setup setup = T3_SETUP_DEFAULTS;
    uint8_t body[T3_SETUP_BODY];
    t3_setup_encode(&setup, body);
    struct t3_settings settings;
    t3_settings_boot(&settings, &PORT);
    t3_settings_write(&settings, &PORT, body);
    while (t3_settings_tick(&settings, &PORT, &CONSOLE) == T3_PROGRESS_NONE)
        ;
    if (keyed)
        t3_session_store_key(&PORT, KEY);
    boot();
    wait(AGE_LIMIT_US);
    make(HELLO);
    deliver(&world.slots[world.host.newest]);
}

static void search(bool with_key, int depth)
{
    struct layer now = {0}, next = {0};
    unsigned long steps = 0, moving = 0;
    int layers = 0;
    keyed = with_key;
    free(seen);
    seen = NULL;
    seen_count = seen_room = 0;
    start();
    is_new(identify());
    keep(&now);
    while (now.count && layers < depth) {
        for (size_t i = 0; i < now.count; i++) {
            for (int action = 0; action < ACTIONS; action++) {
                world = now.worlds[i];
                if (!act(action))
                    continue;
                steps++;
                if (!is_new(identify()))
                    continue;
                moving += world.truth.moving;
                keep(&next);
            }
        }
        const struct layer spare = now;
        now = next;
        next = spare;
        next.count = 0;
        layers++;
    }
    printf("sessions %s: %lu states, %lu of them moving, %lu steps, %d deep, %s\n",
           keyed ? "with a key" : "without a key", (unsigned long)seen_count, moving, steps, layers,
           now.count ? "not all" : "all");
    CHECK(moving);
    free(now.worlds);
    free(next.worlds);
}

int main(int count, char **arguments)
{
    const int depth = count > 1 ? atoi(arguments[1]) : 1000;
    atexit(explain);
    search(true, depth);
    search(false, depth);
    finished = true;
    free(seen);
    return 0;
}
