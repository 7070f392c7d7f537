// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The banner, the e-stop and the buttons of commands.
'use strict';

const CONFIRM = 500; // ms within which a stop must be confirmed, and between two attempts
const STOP_PATIENCE = 5000; // ms that an attempt waits: longer than the program does for the robot
const ATTEMPTS = 3; // that wait at a time, of the six connections of a browser
const RELOAD = 30000; // ms for which a stop is asked for again after the page loads itself anew

let pressed = null; // s, when the stop was asked for that is not confirmed yet
let stopping = ''; // why it is not

// -- banner --------------------------------------------------------------------------------------

function showBanner() {
  let shown = connected ? facts.banner || { kind: 'lost', headline: 'Connected', detail: '' }
    : { kind: 'lost', headline: 'This page has lost its program',
      detail: 'It connects again by itself as soon as t3mpc view runs.' };
  // What the robot says itself counts, if it was asked after the press.
  if (stopping && !(shown.headline === 'E-STOP' && replied > pressed)) {
    shown = { kind: 'unconfirmed', headline: 'STOP NOT CONFIRMED: use the switch on the robot',
      detail: `${stopping}; asking again` };
  }
  place('banner').className = shown.kind + (isExpanded() ? ' expanded' : '');
  place('headline').textContent = shown.headline;
  place('detail').textContent = place('detail').title = shown.detail;
  const robot = facts.namespace ?? ''; // of several robots, the one that this page shows and stops
  place('namespace').textContent = robot;
  document.title = [shown.headline, robot, 't3mpc_ros'].filter(Boolean).join(' – ');
  place('release').hidden = readOnly || shown.headline !== 'E-STOP';
  place('e-stop').disabled = readOnly;
  showMore();
}

const isExpanded = () => place('banner').classList.contains('expanded');

// Offer what of the reason does not fit, as on a phone.
function showMore() {
  const isCut = (part) => part.scrollHeight > part.clientHeight + 1;
  place('more').hidden = !isExpanded() && ![place('headline'), place('detail')].some(isCut);
  place('more').textContent = isExpanded() ? 'less' : 'more';
  place('more').setAttribute('aria-expanded', String(isExpanded()));
}

// -- commands ------------------------------------------------------------------------------------

// Send a command; return what was done, or throw why not.
async function send(name, args, asked, patience) {
  const reply = await fetch('command', {
    method: 'POST',
    headers: { 'Content-Type': 'application/json', 'X-Token': token },
    body: JSON.stringify({ command: name, arguments: args, asked: asked ?? undefined }),
    signal: AbortSignal.timeout(patience),
    priority: 'high',
  });
  const result = await reply.json();
  if (!reply.ok) throw new Error(result.error);
  return result.done;
}

const asked = () => clock === null ? null : clock + steady();

async function command(name, args = {}, patience = 5000) {
  const answer = place('answer');
  answer.className = '';
  answer.textContent = `${name} …`;
  try {
    answer.textContent = await send(name, args, asked(), patience);
    return true;
  } catch (error) {
    answer.className = 'failed';
    answer.textContent = `not done: ${error.message}`;
    return false;
  }
}

// When a stop was asked for that is not confirmed, for the page that loads itself anew. A browser
// may refuse to keep anything: that must not be in the way of the stop.
function keptStop(time) {
  try {
    if (time === undefined) return sessionStorage.getItem('stop');
    if (time === null) sessionStorage.removeItem('stop'); else sessionStorage.setItem('stop', time);
  } catch { /* then it is not asked for again after a reload */ }
  return null;
}

// Ask for a stop until one attempt is confirmed. They overlap: a machine may be so slow that each
// takes longer than the time to the next, and a stop may arrive twice.
async function emergencyStop() {
  if (readOnly || pressed !== null) return;
  const begun = pressed = steady();
  place('answer').className = ''; // the last one may be of a stop before
  place('answer').textContent = 'e_stop …';
  const time = asked();
  const late = setTimeout(() => unconfirmed(begun, 'no answer yet'), CONFIRM);
  keptStop(Date.now());
  let again;
  const done = await new Promise((confirm) => {
    let waiting = 0;
    const ask = () => {
      if (waiting >= ATTEMPTS) return;
      waiting += 1;
      send('e_stop', { on: true }, time, STOP_PATIENCE)
        .then(confirm, (error) => unconfirmed(begun, error.name === 'TimeoutError' ? 'no answer' : error.message))
        .finally(() => { waiting -= 1; });
    };
    ask();
    again = setInterval(ask, CONFIRM);
  });
  clearTimeout(late);
  clearInterval(again);
  unconfirmed(begun, '');
  pressed = null;
  keptStop(null);
  place('answer').className = '';
  place('answer').textContent = done;
}

// Show why the stop that was asked for at an instant is not confirmed; '' for one that is.
function unconfirmed(begun, why) {
  if (begun !== pressed) return; // of an attempt at a stop that another one has confirmed
  stopping = why;
  showBanner();
}

const BUTTONS = [
  ['controller', 'Enable', 'enable', { on: true }, 'Let the controller drive'],
  ['controller', 'Disable', 'enable', { on: false }, 'Stop the robot; Enable drives on'],
  ['controller', 'Reset controller', 'reset', {}, 'Discard what was learnt in this run'],
  ['robot', 'Reset odometry', 'reset_odometry', {}, 'Set the odometry to the origin'],
  ['reference_generator', 'Pause reference', 'pause', { on: true }, 'The reference rests'],
  ['reference_generator', 'Resume reference', 'pause', { on: false }, 'The reference goes on'],
  ['reference_generator', 'Reseed', 'reseed', {}, 'Another path, from a random seed'],
];

function showButtons() {
  const nodes = new Set(facts.nodes);
  if (nodes.has('sim_robot') || nodes.has('radio_bridge')) nodes.add('robot');
  place('buttons').replaceChildren(...BUTTONS.filter(([node]) => nodes.has(node)).map(
    ([, text, name, args, title]) => element('button', { type: 'button', textContent: text, title,
      disabled: readOnly, onclick: () => command(name, args) })));
  if (readOnly) place('answer').textContent = 'started with --read-only: commands are off';
}

// What the recorder does: it begins a bag, and ends it with a report.
function showRecorder() {
  const { state, text, report, failed } = facts.recorder;
  const begins = state === 'idle';
  place('record-box').hidden = false;
  place('record').textContent = begins ? 'Record' : 'End recording, draw report';
  place('record').disabled = readOnly || !(begins || state === 'recording');
  place('record').className = state === 'recording' ? 'recording' : '';
  place('record-text').textContent = text;
  place('record-text').className = failed ? 'numbers failed' : 'numbers';
  place('report').hidden = !report;
}

place('record').onclick = async () => {
  place('record').disabled = true; // a second press would be another command
  const done = await command('record', { on: facts.recorder.state === 'idle' }, 90000);
  if (done) place('answer').textContent = ''; // it stands beside the button
  showRecorder();
};
place('state').onclick = () => { place('banner').classList.toggle('expanded'); showMore(); };
window.addEventListener('resize', showMore);
place('e-stop').onclick = emergencyStop;
place('release').onclick = () => command('e_stop', { on: false });

// The space bar stops wherever the focus is, but where a text is typed: before the focused element
// gets it (a button would be pressed, a list opened), when it goes down and when it comes up.
const isText = (target) => target.matches?.('input[type="text"], input[type="search"], textarea');
const isStop = (key) => key.code === 'Space' && !readOnly && !facts.recording && !isText(key.target)
  && !(key.ctrlKey || key.metaKey || key.altKey);
for (const kind of ['keydown', 'keyup']) {
  window.addEventListener(kind, (key) => {
    if (!isStop(key)) return;
    key.preventDefault();
    key.stopPropagation();
    if (kind === 'keydown' && !key.repeat) emergencyStop();
  }, { capture: true });
}
