// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The timeline: events, marked in the charts, each of which leads to its instant.
'use strict';

const MARKS = { switch: 'switch', stop: 'stopped', fault: 'fault', slip: 'slip', stall: 'c4', gap: 'soft', jump: 'c5',
  parameter: 'accent', change: 'fault' }; // their colours

function addEvent(event) {
  events.push(event);
  if (events.length > 500) events.shift();
  markEvents();
  const row = element('li', { className: event.kind },
    element('button', { type: 'button', className: 'numbers', textContent: timeText(event.time, 0),
      title: facts.origin ? `${clockText(event.time, 2)}: show this instant` : 'Show this instant',
      onclick: () => showInstant(event.time) }),
    element('span', { textContent: event.kind }), element('span', { textContent: event.text }));
  place('events').prepend(row);
  while (place('events').children.length > 200) place('events').lastChild.remove();
  if (event.kind === 'parameter') addChange(event);
}

function showInstant(time) {
  selection = [time - 5, time + 5];
  setPlaying(false);
  seek(time);
}

// Mark the events in the charts, and say which line is what.
function markEvents() {
  if (!charts) return;
  charts.marks = events.filter(({ kind }) => MARKS[kind])
    .map(({ time, kind }) => ({ time, colour: MARKS[kind] }));
  const kinds = Object.keys(MARKS).filter((each) => events.some(({ kind }) => kind === each));
  place('marks').replaceChildren(...kinds.map((kind) =>
    element('li', {}, sample(MARKS[kind], [4, 4]), kind)));
}
