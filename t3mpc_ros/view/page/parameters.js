// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The parameters of the nodes, and what a change of one did.
'use strict';

function showParameters(node) {
  const id = `node-${node}`;
  const rows = (facts[`parameters/${node}`] || []).filter((row) => row.dynamic);
  let box = place(id);
  if (!rows.length) { box?.remove(); return; }
  if (!box) {
    box = element('div', { id });
    const after = [...place('parameters').children].find((each) => each.id > id);
    place('parameters').insertBefore(box, after || null);
  }
  for (const [title, part] of groups(node, rows)) {
    const key = `${id}-${title}`;
    const group = place(key) || box.appendChild(
      element('details', { id: key }, element('summary', { textContent: title })));
    for (const row of part) showParameter(node, row, group);
  }
  filterParameters();
}

function groups(node, rows) {
  const faults = rows.filter((row) => row.name.startsWith('faults.'));
  const others = rows.filter((row) => !row.name.startsWith('faults.'));
  return [[`Faults of ${node}`, faults], [node, others]].filter(([, part]) => part.length);
}

function showParameter(node, row, group) {
  const id = `${node}/${row.name}`;
  const known = place(id);
  if (known) { known.show(row.value); return; }
  const { input, read, write } = entry(row);
  const send = () => {
    const value = read();
    if (value !== undefined && JSON.stringify(value) !== JSON.stringify(box.value)) {
      command('set', { node, name: row.name, value })
        .then((done) => { if (done) box.value = value; else write(box.value); });
    }
  };
  const unit = row.unit ? ` ${row.unit}` : '';
  const bounds = row.low === null && row.high === null ? ''
    : ` (${row.low === null ? '' : `from ${row.low} `}${row.high === null ? '' : `to ${row.high}`}${unit})`;
  const box = element('div', { id, className: 'parameter' },
    element('label', {}, element('span', { textContent: row.name }),
      element('span', { className: 'entry' }, input, unit)));
  const slider = makeSlider(row, read, write, send);
  if (slider) box.append(slider);
  box.append(element('p', { textContent: `${row.text}${bounds}` }));
  input.onchange = send;
  input.disabled = readOnly;
  box.show = (value) => {
    box.value = value;
    if (document.activeElement !== input) { write(value); slider?.place(value); }
  };
  box.show(row.value);
  group.append(box);
}

// The input of a parameter, and how to read and write its value.
function entry(row) {
  if (row.type === 'bool') {
    const input = element('input', { type: 'checkbox' });
    return { input, read: () => input.checked, write: (value) => { input.checked = value; } };
  }
  if (row.choices.length) {
    const input = element('select', {}, ...row.choices.map((each) => element('option', { textContent: each })));
    return { input, read: () => input.value, write: (value) => { input.value = value; } };
  }
  const isNumber = row.type === 'float' || row.type === 'int';
  const isList = row.type.startsWith('list');
  const input = element('input', isNumber ? { type: 'number', step: 'any' } : { type: 'text' });
  const read = () => {
    if (!isNumber && !isList) return input.value;
    try { return isList ? JSON.parse(`[${input.value}]`) : JSON.parse(input.value); } catch { return undefined; }
  };
  return { input, read, write: (value) => { input.value = isList ? value.join(', ') : value; } };
}

// A slider for a number with bounds. Its middle is the first value, for ranges of many decades.
function makeSlider(row, read, write, send) {
  if (!['float', 'int'].includes(row.type) || row.low === null || row.high === null) return null;
  const span = row.high - row.low;
  const share = (row.value - row.low) / span;
  const power = row.low < 0 || share <= 0 ? 1 : Math.min(12, Math.max(1, Math.log(share) / Math.log(0.5)));
  const slider = element('input', { type: 'range', min: 0, max: 1000, disabled: readOnly,
    ariaLabel: `${row.name}, slider` });
  slider.place = (value) => { slider.value = 1000 * ((value - row.low) / span) ** (1 / power); };
  slider.oninput = () => {
    const value = row.low + span * (slider.value / 1000) ** power;
    write(row.type === 'int' ? Math.round(value) : +value.toPrecision(3));
  };
  slider.onchange = send;
  return slider;
}

function filterParameters() {
  const words = place('search').value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const box of place('parameters').querySelectorAll('.parameter')) {
    const text = box.textContent.toLowerCase();
    box.hidden = !words.every((word) => text.includes(word));
  }
  for (const group of place('parameters').querySelectorAll('details')) {
    const found = group.querySelectorAll('.parameter:not([hidden])').length;
    group.hidden = !found;
    if (words.length) group.open = found > 0;
  }
}
place('search').oninput = filterParameters;

// -- what a change did -------------------------------------------------------------------------------

const AROUND = 10; // s before and after a change whose errors are compared
const CARDS = 5;
const cards = []; // {time, box}, of changes whose time after is not over yet

// A card that compares the errors before and after a parameter was changed.
function addChange({ time, text }) {
  const box = element('li', {}, element('p', { textContent: text }),
    element('p', { className: 'numbers', textContent: `measures ${AROUND} s after it` }));
  place('changes-box').hidden = false;
  place('changes').prepend(box);
  while (place('changes').children.length > CARDS) place('changes').lastChild.remove();
  cards.push({ time, box });
}

function fillCards() {
  while (cards.length && newest() >= cards[0].time + AROUND) {
    const { time, box } = cards.shift();
    const [before, after] = [[time - AROUND, time], [time, time + AROUND]].map(errorsIn);
    const text = (errors, i) => (errors[i] === null ? '–' : number(errors[i], 4));
    const unit = facts.channels ? facts.channels.map((each) => each[1]) : ['rad/s', 'rad/s'];
    const line = (name, i) => `${name}: ${text(before, i)} before, ${text(after, i)} ${unit[i]} after`;
    box.lastChild.textContent = `RMSE of ${AROUND} s, ${line('right', 0)}; ${line('left', 1)}`;
  }
}

// RMSE of both channels in a range, as far as the robot was commanded to move; null without any.
function errorsIn(range) {
  const { error, command } = shownStreams(range);
  return error.values.map((column) => {
    const squares = column.filter((each, row) => {
      const [at, k] = [error.time[row], rowAt(command.time, error.time[row])];
      return each !== null && at >= range[0] && at < range[1] && command.values.some((value) => value[k]);
    }).map((each) => each * each);
    return squares.length ? Math.sqrt(squares.reduce((a, b) => a + b, 0) / squares.length) : null;
  });
}
