// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// A path, or a goal, that a person draws on the floor for a reference of source topic; a patrol that
// plans takes goals.
'use strict';

const SPACING = 0.02; // m between two points of a line
const MAX_POINTS = 120; // that a command holds
const GOAL = 0.05; // m of a line up to which it is a point, the goal

let drawnPath = null; // {x, y} on the map, as long as no other one is drawn
let drawingLine = false; // whether a line is being drawn

function showDrawing() {
  const rows = facts['parameters/reference_generator'] || [];
  const is = (wanted, given) => rows.some(({ name, value }) => name === wanted && value === given);
  const takes = is('source', 'topic') || (is('source', 'portrait') && is('plan.enabled', true));
  place('draw').hidden = readOnly || !takes;
}

function setDrawing(on) {
  place('draw').setAttribute('aria-pressed', String(on));
  place('draw').textContent = on ? 'Do not draw' : 'Draw path or goal';
  place('floor').classList.toggle('drawing', on);
}

const isDrawing = () => place('draw').getAttribute('aria-pressed') === 'true';

function addPoint(event) {
  const [x, y] = floor.placeAt(event.offsetX, event.offsetY);
  const last = [drawnPath.x.at(-1), drawnPath.y.at(-1)];
  if (!(Math.hypot(x - last[0], y - last[1]) < SPACING)) {
    drawnPath.x.push(x);
    drawnPath.y.push(y);
    moved = true;
  }
}

// The points of the line in the frame of the odometry; the last one alone if it is a goal.
function drawnPoints({ x, y }) {
  const length = x.slice(1).reduce((sum, at, i) => sum + Math.hypot(at - x[i], y[i + 1] - y[i]), 0);
  const every = Math.ceil(x.length / MAX_POINTS);
  const kept = x.map((_, i) => i).filter((i) => i === x.length - 1 || (length > GOAL && i % every === 0));
  const frame = inverse(base);
  return kept.map((i) => compose(frame, [x[i], y[i], 0]).slice(0, 2).map((each) => +each.toFixed(3)));
}

place('floor').addEventListener('pointerdown', (event) => {
  if (!isDrawing() || !base) return;
  place('floor').setPointerCapture(event.pointerId);
  [drawingLine, drawnPath] = [true, { x: [], y: [], colour: 'accent', dash: [] }];
  addPoint(event);
});
place('floor').addEventListener('pointermove', (event) => { if (drawingLine) addPoint(event); });
place('floor').addEventListener('pointercancel', () => { [drawingLine, drawnPath] = [false, null]; });
place('floor').addEventListener('pointerup', (event) => {
  if (!drawingLine) return;
  addPoint(event);
  drawingLine = false;
  setDrawing(false);
  command('path', { points: drawnPoints(drawnPath) });
});
place('draw').onclick = () => setDrawing(!isDrawing());
