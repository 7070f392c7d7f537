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
#include "t3_robot.h"

#include <stddef.h>
#include <string.h>

#include "t3_bytes.h"
#include "t3_requests.h"
#include "t3_sensors.h"
#include "t3_telemetry.h"

#define TTL_UNIT_US UINT32_C(10000)

static int32_t parameter(const struct t3_robot *robot, uint8_t id)
{
    return robot->parameters.values[id];
}

// Come to rest, and stay there until a command allows otherwise.
static void disable(struct t3_robot *robot)
{
    robot->enabled = false;
    robot->ttl_runs = false;
    t3_ramp_halt(&robot->ramp);
}

static void latch_estop(struct t3_robot *robot)
{
    robot->estop = true;
    disable(robot);
}

static bool button(const struct t3_robot *robot)
{
    return robot->port->estop_pressed(robot->port->context);
}

// -- packets -------------------------------------------------------------------------------------

// Note why a payload is refused, and count it. Its first bytes identify it; what it lacks is 0.
static void refuse(struct t3_robot *robot, enum t3_refusal why, const uint8_t *data, uint8_t size)
{
    robot->refusal = (uint8_t)why;
    for (uint8_t i = 0; i < T3_HEADER_SIZE; i++)
        robot->refused[i] = i < size ? data[i] : 0;
    switch (why) {
    case T3_REFUSED_VERSION:
        robot->counters.bad_version++;
        return;
    case T3_REFUSED_FORM:
        robot->counters.malformed++;
        return;
    case T3_REFUSED_SEQUENCE:
        robot->counters.duplicates++;
        return;
    case T3_REFUSED_STALE:
        robot->counters.stale++;
        return;
    default:
        robot->counters.bad_session++;
    }
}

static enum t3_refusal take_hello(struct t3_robot *robot, const struct t3_packet *packet,
                                  const uint8_t *data, uint32_t received_us)
{
    // Even after a rejection, INFO reports the reason, the current session, the state of the settings,
    // and whether a key is stored.
    t3_answer_with(robot, T3_INFO, packet->seq, 0, 0);
    // Its address is that of every such board, and its microsteps are unknown.
    if (!t3_settings_usable(&robot->settings) || !t3_calibration_usable(&robot->calibration))
        return T3_REFUSED_SETTINGS;
    bool repeated;
    const enum t3_refusal why =
        t3_session_greet(&robot->session, robot->port, packet, data, &repeated);
    if (why != T3_ADMITTED)
        return why;
    robot->refusal = T3_ADMITTED;  // what was refused before does not concern this session
    if (repeated)
        return T3_ADMITTED;
    disable(robot);
    robot->expired = robot->limited = false;
    robot->seq_known = robot->command_seen = robot->action_done = false;
    robot->seq = 0;
    robot->last_frame_us = received_us;
    return T3_ADMITTED;
}

static bool clears_estop(const struct t3_robot *robot, const struct t3_packet *packet)
{
    return packet->what == T3_FLAG_ESTOP_CLEAR && !packet->left && !packet->right &&
           !robot->pressed && !button(robot);
}

static void follow(struct t3_robot *robot, const struct t3_packet *packet, uint32_t received_us,
                   uint32_t ttl_us)
{
    robot->expired = robot->limited = false;
    if (clears_estop(robot, packet))
        robot->estop = false;
    if (robot->estop || robot->flat || !(packet->what & T3_FLAG_ENABLE)) {
        disable(robot);
        return;
    }
    robot->enabled = true;
    robot->ttl_runs = ttl_us != 0;
    robot->ttl_from_us = received_us;
    robot->ttl_us = ttl_us;
    if (!ttl_us) {
        t3_ramp_halt(&robot->ramp);  // a TTL of 0 is a wish to stop, not an accident
        return;
    }
    int32_t limit = parameter(robot, T3_MAX_SPEED);
    if (limit > robot->top_speed)
        limit = robot->top_speed;
    robot->limited = t3_ramp_aim(&robot->ramp, packet->left, packet->right, limit);
}

static bool wants_to_stand(const struct t3_packet *packet)
{
    return !(packet->what & T3_FLAG_ENABLE) || !packet->ttl || (!packet->left && !packet->right);
}

// Return for how long a CMD may be followed, by the age of its echo: its TTL, less what the echo is
// older than usual; UINT32_MAX if nothing is left. An echo from the future has an age near 2**32 us.
static uint32_t time_to_follow(uint32_t ttl_us, uint32_t age_us)
{
    if (age_us <= T3_ECHO_AGE_US)
        return ttl_us;
    const uint32_t excess_us = age_us - T3_ECHO_AGE_US;
    return excess_us < ttl_us ? ttl_us - excess_us : UINT32_MAX;
}

static enum t3_refusal take_command(struct t3_robot *robot, const struct t3_packet *packet,
                                    uint32_t received_us)
{
    const uint8_t ahead = (uint8_t)(packet->seq - robot->seq);
    if (robot->seq_known && (ahead == 0 || ahead >= 0x80))
        return T3_REFUSED_SEQUENCE;
    uint32_t ttl_us = packet->ttl * TTL_UNIT_US;
    const uint32_t longest = (uint32_t)parameter(robot, T3_TTL_MAX) * 1000u;
    if (ttl_us > longest)
        ttl_us = longest;
    ttl_us = time_to_follow(ttl_us, received_us - packet->echo_us);
    if (ttl_us == UINT32_MAX) {
        // A wish to stand is never too late; it does not count as a command otherwise.
        if (wants_to_stand(packet))
            t3_ramp_halt(&robot->ramp);
        return T3_REFUSED_STALE;
    }
    robot->seq_known = robot->command_seen = true;
    robot->seq = packet->seq;
    robot->command_us = received_us;
    follow(robot, packet, received_us, ttl_us);
    return T3_ADMITTED;
}

static void take_poll(struct t3_robot *robot, const struct t3_packet *packet)
{
    static const uint8_t KINDS[] = {
        [T3_POLL_STATE] = T3_STATE, [T3_POLL_AUX] = T3_AUX, [T3_POLL_INFO] = T3_INFO};
    t3_answer_with(robot, KINDS[packet->what], packet->seq, 0, 0);
}

// What only the host of the session may do. PARAM_GET changes nothing, so it needs no tag.
static enum t3_refusal admit(struct t3_robot *robot, const struct t3_packet *packet,
                             const uint8_t *data, uint8_t size)
{
    if (packet->kind != T3_PARAM_GET)
        return t3_session_admit(&robot->session, packet, data, size);
    const bool mine = robot->session.id && packet->session == robot->session.id;
    return mine ? T3_ADMITTED : T3_REFUSED_SESSION;
}

static enum t3_refusal take(struct t3_robot *robot, const uint8_t *data, uint8_t size,
                            uint32_t received_us)
{
    struct t3_packet packet;
    enum t3_refusal why = t3_decode(data, size, &packet);
    if (why != T3_ADMITTED)
        return why;
    if (packet.kind == T3_HELLO)
        return take_hello(robot, &packet, data, received_us);
    if (packet.kind == T3_POLL) {
        take_poll(robot, &packet);
        return T3_ADMITTED;
    }
    why = admit(robot, &packet, data, size);
    if (why != T3_ADMITTED)
        return why;
    robot->last_frame_us = received_us;
    if (packet.kind == T3_CMD)
        return take_command(robot, &packet, received_us);
    t3_request(robot, &packet);
    return T3_ADMITTED;
}

void t3_robot_packet(struct t3_robot *robot, const uint8_t *data, uint8_t size,
                     uint32_t received_us)
{
    robot->counters.received++;
    if (size > T3_RADIO_LIMIT) {
        // The chip never gives more; whatever claims to be wider is not even looked at.
        refuse(robot, T3_REFUSED_FORM, data, 0);
        return;
    }
    if (t3_asks_to_stop(data, size))
        latch_estop(robot);
    // The reply to an invalid packet is STATE.
    t3_answer_with(robot, T3_STATE, 0, 0, 0);
    robot->answer_waits = true;
    robot->answer_from_us = received_us;
    const enum t3_refusal why = take(robot, data, size, received_us);
    if (why != T3_ADMITTED)
        refuse(robot, why, data, size);
    // A host of another version learns the version of the robot, in a frame that it can read.
    if (why == T3_REFUSED_VERSION && t3_asks_for_identity(data, size)) {
        t3_answer_with(robot, T3_INFO, data[2], 0, 0);
        robot->answer.version = data[0] >> 4;
    }
}

struct t3_answer t3_robot_cable(struct t3_robot *robot, const uint8_t *data, uint8_t size,
                                uint32_t received_us)
{
    const struct t3_answer waiting = robot->answer;
    const bool waits = robot->answer_waits;
    const uint32_t from_us = robot->answer_from_us;
    t3_robot_packet(robot, data, size, received_us);
    const struct t3_answer made = robot->answer;
    robot->answer = waiting;
    robot->answer_waits = waits;
    robot->answer_from_us = from_us;
    return made;
}

uint8_t t3_robot_cable_answer(struct t3_robot *robot, struct t3_answer answer, uint8_t *to)
{
    const struct t3_answer waiting = robot->answer;
    robot->answer = answer;
    const uint8_t size = t3_telemetry(robot, robot->port->time_us(robot->port->context), to);
    robot->answer = waiting;
    return size;
}

// -- time ----------------------------------------------------------------------------------------

static void watch_ttl(struct t3_robot *robot, uint32_t now_us)
{
    // Signed: a command may have come after this tick read the clock.
    if (!robot->ttl_runs ||
        t3_later_by(now_us, robot->ttl_from_us) < (int32_t)robot->ttl_us)
        return;
    robot->ttl_runs = false;
    robot->expired = true;
    robot->counters.expired++;
    t3_ramp_halt(&robot->ramp);
}

static void watch_button(struct t3_robot *robot, uint32_t now_us)
{
    const bool input = button(robot);
    if (input == robot->pressed)
        robot->button_us = now_us;
    else if (now_us - robot->button_us >= (input ? T3_PRESS_US : T3_RELEASE_US))
        robot->pressed = input;
    if (robot->pressed)
        latch_estop(robot);
}

static void measure_battery(struct t3_robot *robot)
{
    const uint16_t count = robot->port->adc(robot->port->context, T3_ADC_BATTERY);
    const uint32_t supply = t3_calibration_battery(
        &robot->calibration, t3_battery_mv_of(robot->settings.now.divider, count));
    const bool wired = robot->settings.now.wired;
    if ((!supply && !wired) || !robot->battery_sum)
        robot->battery_sum = T3_BATTERY_WEIGHT * supply;
    else
        robot->battery_sum += supply - robot->battery_sum / T3_BATTERY_WEIGHT;
    const int32_t filtered = t3_robot_battery(robot);
    const int32_t cutoff = parameter(robot, T3_BATTERY_CUTOFF);
    const int32_t low = parameter(robot, T3_BATTERY_LOW);
    // The voltage rises as soon as the motors rest: below the warning, the robot stays off.
    if ((!filtered && !wired) || (filtered >= cutoff && filtered >= low))
        robot->flat = false;
    else if (filtered < cutoff)
        robot->flat = true;
}

static void watch_battery(struct t3_robot *robot, uint32_t now_us)
{
    if (now_us - robot->battery_us < T3_BATTERY_PERIOD_US)
        return;
    robot->battery_us = now_us;
    measure_battery(robot);
    if (robot->flat)
        disable(robot);
}

static void watch_clock(struct t3_robot *robot, uint32_t now_us)
{
    // An age beyond its field is none, also when the clock has come round.
    if (robot->command_seen && t3_later_by(now_us, robot->command_us) > INT32_C(1000000))
        robot->command_seen = false;
    if (robot->session.id &&
        t3_later_by(now_us, robot->last_frame_us) > (int32_t)T3_SESSION_SILENCE_US) {
        t3_session_end(&robot->session);
        disable(robot);
    }
}

static void move_on(struct t3_robot *robot, uint32_t elapsed_us)
{
    if (t3_ramp_settled(&robot->ramp))
        return;  // and the increments are what they were: most periods cost nothing
    int32_t deceleration = parameter(robot, T3_DECELERATION);
    if (robot->estop && deceleration < T3_ESTOP_DECELERATION)
        deceleration = T3_ESTOP_DECELERATION;
    t3_ramp_step(&robot->ramp, parameter(robot, T3_ACCELERATION), deceleration, elapsed_us);
    int32_t increments[T3_WHEELS];
    for (uint8_t i = 0; i < T3_WHEELS; i++)
        increments[i] = t3_steps_increment(&robot->steps, robot->ramp.speed[i]);
    robot->port->lock(robot->port->context);
    for (uint8_t i = 0; i < T3_WHEELS; i++)
        robot->steps.wheels[i].increment = increments[i];
    robot->port->unlock(robot->port->context);
}

// One at a time: eight at once, just when a state is due, would make it late. The sensors measure
// every 38 ms.
static void read_range(struct t3_robot *robot)
{
    const uint8_t channel = robot->next_range;
    struct t3_curve curve;
    const bool calibrated = t3_calibration_curve(&robot->calibration, channel, &curve);
    robot->ranges[channel] =
        t3_range_code_of(robot->settings.now.sensors[channel], calibrated ? &curve : NULL,
                         robot->port->adc(robot->port->context, channel));
    robot->next_range = (uint8_t)((channel + 1u) % T3_RANGES);
}

static void keep_period(struct t3_robot *robot, uint32_t now_us)
{
    const uint32_t elapsed_us = now_us - robot->period_us;
    if (elapsed_us < T3_PERIOD_US)
        return;
    robot->period_us = now_us;
    move_on(robot, elapsed_us);
    read_range(robot);
}

static void watch_idleness(struct t3_robot *robot, uint32_t now_us)
{
    if (t3_ramp_busy(&robot->ramp)) {
        robot->resting = robot->idle = false;
        return;
    }
    if (!robot->resting) {
        robot->resting = true;
        robot->rest_us = now_us;
    }
    // Kept once it is so: the clock comes round while a robot stands for hours.
    const uint32_t allowed = (uint32_t)parameter(robot, T3_IDLE_OFF) * 1000u;
    robot->idle = allowed && (robot->idle || now_us - robot->rest_us >= allowed);
}

static void power(struct t3_robot *robot, uint32_t now_us)
{
    watch_idleness(robot, now_us);
    // A motor without power rolls on: the drivers keep it until the ramp has ended.
    const bool on = t3_ramp_moving(&robot->ramp) || (robot->enabled && !robot->idle);
    if (on != robot->powered)
        robot->port->drivers(robot->port->context, on);
    robot->powered = on;
}

static void load(struct t3_robot *robot, uint32_t now_us)
{
    if (robot->answer_waits) {
        if (t3_later_by(now_us, robot->answer_from_us) < (int32_t)robot->settle_us)
            return;
    } else if (now_us - robot->loaded_us < T3_REFRESH_US) {
        return;
    } else {
        t3_answer_with(robot, T3_STATE, 0, 0, 0);
    }
    uint8_t payload[T3_RADIO_LIMIT];
    const uint8_t size = t3_telemetry(robot, now_us, payload);
    robot->answer_waits = false;
    robot->loaded_us = now_us;
    robot->port->load_ack(robot->port->context, payload, size);
}

void t3_robot_tick(struct t3_robot *robot)
{
    const uint32_t now_us = robot->port->time_us(robot->port->context);
    const uint32_t pass_us = now_us - robot->tick_us;
    if (pass_us > robot->longest_us)
        robot->longest_us = pass_us < UINT16_MAX ? (uint16_t)pass_us : UINT16_MAX;
    robot->tick_us = now_us;
    watch_button(robot, now_us);
    watch_battery(robot, now_us);
    watch_ttl(robot, now_us);
    watch_clock(robot, now_us);
    power(robot, now_us);  // before the ramp: no step reaches a driver without power
    load(robot, now_us);  // the POLL comes soon; the ramp can wait for as long as this takes
    keep_period(robot, now_us);
}

static void scale_steps(struct t3_robot *robot)
{
    robot->microsteps = robot->settings.now.microsteps;
    robot->parameters.values[T3_MICROSTEPS] = robot->microsteps;
    const uint32_t steps_per_turn = robot->settings.now.steps_per_turn;
    robot->parameters.values[T3_STEPS_PER_REV] = (int32_t)steps_per_turn;
    t3_steps_scale(&robot->steps, steps_per_turn * robot->microsteps);
    robot->top_speed = (int32_t)(robot->steps.top_speed / 1000u);
}

void t3_robot_use_settings(struct t3_robot *robot)
{
    robot->port->lock(robot->port->context);
    scale_steps(robot);
    robot->port->unlock(robot->port->context);
    t3_robot_invert(robot);
    robot->battery_sum = 0;  // in mV of another divider: not to be filtered with it
}

void t3_robot_boot(struct t3_robot *robot, const struct t3_port *port, uint8_t reset_cause,
                   uint16_t settle_us)
{
    memset(robot, 0, sizeof *robot);
    robot->port = port;
    port->drivers(port->context, false);
    robot->reset_cause = reset_cause;
    robot->settle_us = settle_us;
    robot->period_us = robot->loaded_us = robot->tick_us = port->time_us(port->context);
    robot->button_us = robot->battery_us = robot->loaded_us;
    t3_parameters_start(&robot->parameters);
    t3_settings_boot(&robot->settings, port);
    t3_calibration_boot(&robot->calibration, port);
    scale_steps(robot);  // the step interrupt does not run yet
    robot->steps.inverted = robot->settings.now.inverted;
    measure_battery(robot);
    robot->session.boots = t3_session_count_boot(port);
    robot->parameters.values[T3_BOOTS] = (int32_t)(robot->session.boots & INT32_MAX);
    t3_session_boot(&robot->session, port);
    // The first packet fetches a state too.
    t3_answer_with(robot, T3_STATE, 0, 0, 0);
    robot->answer_waits = true;
    robot->answer_from_us = robot->loaded_us - settle_us;
}
