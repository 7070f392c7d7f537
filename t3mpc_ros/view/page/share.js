// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// What is shown as one file, which opens anywhere without the program.
'use strict';

const ALONE = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:";

// The facts, and the part of streams and events within a range, as news that begin with it.
function newsOf([from, to]) {
  const parts = Object.entries(streams).map(([name, { time, values }]) => {
    const part = [rowAt(time, from - 1e-9) + 1, rowAt(time, to) + 1];
    return [name, { time: time.slice(...part), values: values.map((each) => each.slice(...part)) }];
  });
  const kept = Object.entries(facts).filter(([name]) => !['nodes', 'recorder'].includes(name) && !name.startsWith('parameters/'));
  const shown = facts.recording ? facts.banner.headline : 'Part of a run';
  const begins = facts.origin ? `, ${new Date((facts.origin + from) * 1000).toLocaleString()}` : '';
  return {
    facts: { ...Object.fromEntries(kept), recording: { live: true, ...facts.recording, duration: to - from },
      banner: { kind: 'good', headline: `${shown}: ${timeText(from, 1)} to ${timeText(to, 1)}`,
        detail: `${number(to - from, 1)} s${begins}` }, added, follows_path: followsPath() },
    streams: Object.fromEntries(parts.filter(([, { time }]) => time.length)),
    events: events.filter(({ time }) => time >= from && time <= to),
  };
}

async function shareSpan() {
  const [from, to] = shownRange();
  const page = new DOMParser().parseFromString(await (await fetch('view.html')).text(), 'text/html');
  page.querySelector('meta[name="token"]').content = '';
  for (const link of page.querySelectorAll('link[rel="stylesheet"]')) {
    const text = await (await fetch(link.getAttribute('href'))).text();
    link.replaceWith(element('style', { textContent: text }));
  }
  const scripts = [...page.querySelectorAll('script')];
  for (const script of scripts) {
    const text = await (await fetch(script.getAttribute('src'))).text();
    script.replaceWith(element('script', { textContent: text }));
  }
  const news = newsOf([Math.max(from, begin()), Math.min(to, newest())]);
  const json = JSON.stringify(news).replaceAll('<', '\\u003c'); // a closing tag would end the script
  const head = page.querySelector('meta[charset]');
  head.after(element('meta', { httpEquiv: 'Content-Security-Policy', content: ALONE }));
  page.querySelector('main').after(element('script', { type: 'application/json', id: 'shared', textContent: json }));
  const html = `<!doctype html>\n${page.documentElement.outerHTML}\n`;
  const link = element('a', { download: `run_${Math.round(from)}_to_${Math.round(to)}_s.html`,
    href: URL.createObjectURL(new Blob([html], { type: 'text/html' })) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

place('share').onclick = shareSpan;
place('share').hidden = Boolean(place('shared')); // a file has nothing to fetch
