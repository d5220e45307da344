// SPDX-License-Identifier: Apache-2.0
// The page of viewer_page.py: one cursor for map and plots, layers, sizes of ellipses, and what
// running nodes send. Bokeh draws; every figure and source has the name that Python gave it.
(() => {
  'use strict';
  const LEVELS = ['OK', 'DEGRADED', 'LOST'];
  const COLOURS = ['#6fbf8f', '#e9b53f', '#d9534f'];
  const SIZES = [1, 2, 5, 10, 20, 50];
  const HISTORY = 6000; // frames that a live page keeps
  const LIVE_SCANS = 600;
  const WINDOW = 120; // seconds that the plots of a live page show
  const by = id => document.getElementById(id);
  const isLive = by('viewer').dataset.live === '1';

  let doc, map, cursors, scans = [], k = 0, follows = isLive, playing = 0, touched = false, times;
  const source = name => map.tags.find(s => s.name === name);
  const column = (of, name) => source(of).data[name];

  // --- the cursor ------------------------------------------------------------------------------

  /** Index of the last time that is not after t; 0 before the first. */
  function indexAt(times, t) {
    let low = 0, high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= t) low = middle; else high = middle - 1;
    }
    return low;
  }

  function nearestIndex(times, t) {
    const a = indexAt(times, t), b = Math.min(a + 1, times.length - 1);
    return Math.abs(times[b] - t) < Math.abs(times[a] - t) ? b : a;
  }

  function seek(t) { show(nearestIndex(column('frames', 't'), t)); }

  /** The frame whose place is nearest to a point of the map. */
  function seekPlace(x, y) {
    const { x: xs, y: ys } = source('frames').data;
    const near = 0.03 * (map.x_range.end - map.x_range.start);
    let best = near * near, found = -1;
    for (let i = 0; i < xs.length; i++) {
      const d = (xs[i] - x) ** 2 + (ys[i] - y) ** 2;
      if (d < best) { best = d; found = i; }
    }
    if (found >= 0) { follow(false); show(found); }
  }

  /** Move everything to frame i. */
  function show(i) {
    const f = source('frames').data, n = f.t.length;
    if (!n) return;
    k = Math.max(0, Math.min(i, n - 1));
    const slider = by('slider');
    slider.max = n - 1;
    slider.value = k;
    slider.setAttribute('aria-valuetext', `${f.t[k].toFixed(2)} s`);
    for (const c of cursors) c.location = f.t[k];
    if (follows) times.setv({ start: Math.max(0, f.t[n - 1] - WINDOW), end: Math.max(1, f.t[n - 1]) });
    drawRobot(f);
    drawScan(f);
    say(f);
  }

  const placed = (f, i, x, y) => {
    const a = f.theta[i] * Math.PI / 180, c = Math.cos(a), s = Math.sin(a);
    return [f.x[i] + c * x - s * y, f.y[i] + s * x + c * y];
  };

  function drawRobot(f) {
    const size = 0.016 * (map.x_range.end - map.x_range.start);
    const arrow = [[1.3, 0], [-0.8, 0.8], [-0.4, 0], [-0.8, -0.8]];
    const at = arrow.map(([x, y]) => placed(f, k, size * x, size * y));
    source('robot').data = { x: at.map(p => p[0]), y: at.map(p => p[1]) };
  }

  function drawScan(f) {
    const x = [], y = [];
    if (scans.length) {
      const scan = scans[nearestIndex(scans.map(s => s.t), f.t[k])];
      const i = nearestIndex(f.t, scan.t); // a scan is drawn where the robot was then
      for (let j = 0; j < scan.x.length; j++) {
        const p = placed(f, i, 0.01 * scan.x[j], 0.01 * scan.y[j]);
        x.push(p[0]); y.push(p[1]);
      }
    }
    source('scan').data = { x, y };
  }

  function say(f) {
    const has = name => f[name].length > k && Number.isFinite(f[name][k]);
    const items = [`<b>${f.t[k].toFixed(2)} s</b>`,
      `<b class="level" style="--c:${COLOURS[f.level[k]]}">${LEVELS[f.level[k]]}</b>`,
      `x <b>${f.x[k].toFixed(3)}</b> y <b>${f.y[k].toFixed(3)} m</b>`,
      `heading <b>${f.theta[k].toFixed(2)}°</b>`, `σ <b>${f.sigma[k].toFixed(2)} cm</b>`];
    if (has('error')) items.push(`error <b>${f.error[k].toFixed(2)} cm</b>`);
    if (has('seen')) items.push(`reflectors <b>${f.used[k]} of ${f.seen[k]}</b> used`);
    if (has('ms')) items.push(`<b>${f.ms[k].toFixed(1)} ms</b>`);
    by('now').innerHTML = items.map(i => `<span>${i}</span>`).join('');
    if (f.reason[k]) {
      const why = document.createElement('span');
      why.textContent = f.reason[k];
      by('now').append(why);
    }
  }

  // --- what a person does ----------------------------------------------------------------------

  function follow(yes) {
    follows = isLive && yes;
    label();
    if (follows) show(column('frames', 't').length - 1);
  }

  function label() {
    by('play').textContent = isLive ? (follows ? 'Hold' : 'Follow') : (playing ? 'Pause' : 'Play');
  }

  /** The whole run in a minute, or as it was driven if that is shorter. */
  function play(yes) {
    playing = yes ? playing + 1 || 1 : 0;
    label();
    if (!yes) return;
    const all = column('frames', 't'), mine = playing;
    const speed = Math.max(1, all[all.length - 1] / 60);
    if (k >= all.length - 1) show(0);
    const from = all[k], began = performance.now();
    const step = now => {
      if (playing !== mine) return;
      const t = from + speed * (now - began) / 1000;
      show(indexAt(all, t));
      if (t >= all[all.length - 1]) play(false); else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  function layers() {
    for (const box of document.querySelectorAll('[data-layer]')) {
      const shown = () => {
        for (const r of map.renderers) if (r.name === box.dataset.layer) r.visible = box.checked;
      };
      box.onchange = shown;
      shown();
    }
    const size = by('size');
    size.oninput = () => { by('times').textContent = SIZES[size.value]; ellipses(); };
  }

  function ellipses() {
    const r = source('reflectors').data, times = SIZES[by('size').value];
    source('ellipses').data = {
      x: r.x, y: r.y, angle: r.angle,
      width: Array.from(r.width, v => times * v), height: Array.from(r.height, v => times * v),
    };
  }

  /** One metre is as long in x as in y, whatever the shape of the window. */
  function toScale() {
    const { x_range: x, y_range: y, inner_width: width, inner_height: height } = map;
    if (!(width > 0 && height > 0)) return;
    const metres = Math.max((x.end - x.start) / width, (y.end - y.start) / height);
    for (const [range, pixels] of [[x, width], [y, height]]) {
      const middle = 0.5 * (range.start + range.end), half = 0.5 * metres * pixels;
      if (Math.abs(range.end - middle - half) > 1e-6 * half) {
        range.setv({ start: middle - half, end: middle + half });
      }
    }
    show(k);
  }

  function paper() {
    const dark = matchMedia('(prefers-color-scheme: dark)');
    const grid = map.renderers.find(r => r.name === 'grid').glyph;
    const choose = () => { grid.url = { field: dark.matches ? 'dark' : 'light' }; };
    dark.onchange = choose;
    choose();
  }

  /** Plots whose columns have no number are hidden; so are layers without data. */
  function hideEmpty() {
    for (const box of document.querySelectorAll('[data-needs]')) {
      const [of, name] = box.dataset.needs.split('.');
      const values = of === 'scans' ? scans : column(of, name);
      box.hidden = !values.length || (of === 'frames' && !Array.from(values).some(Number.isFinite));
    }
  }

  // --- what running nodes send -----------------------------------------------------------------

  /** Lists of JSON, which has no NaN. */
  const numbers = columns => Object.fromEntries(Object.entries(columns).map(
    ([name, values]) => [name, values.map(v => v === null ? NaN : v)]));

  function take(message) {
    if (message.start) scans = [];
    for (const [name, columns] of Object.entries(message.replace ?? {})) {
      source(name).data = numbers(columns);
      if (name === 'reflectors') ellipses();
      if (name === 'frames') {
        source('health').data = { left: [], right: [], level: [], name: [], reason: [], colour: [] };
        health(columns);
      }
    }
    for (const [name, columns] of Object.entries(message.stream ?? {})) {
      source(name).stream(numbers(columns), HISTORY);
      if (name === 'frames') health(columns);
    }
    if (message.scan) {
      scans.push(message.scan);
      if (scans.length > LIVE_SCANS) scans.shift();
    }
    if (message.extent && !touched) { // not while a person looks somewhere else
      const [low, high] = message.extent;
      map.x_range.setv({ start: low[0], end: high[0] });
      map.y_range.setv({ start: low[1], end: high[1] });
      toScale();
    }
    if (message.state !== undefined) by('state').textContent = message.state;
    window.viewer.messages += 1;
    window.viewer.latency = message.stamp ? Date.now() - message.stamp : NaN;
    hideEmpty();
    show(follows ? column('frames', 't').length - 1 : k);
  }

  /** The strip of health grows with the frames. */
  function health(f) {
    const h = Object.fromEntries(Object.entries(source('health').data).map(
      ([name, values]) => [name, Array.from(values)]));
    for (let i = 0; i < f.t.length; i++) {
      const last = h.left.length - 1;
      if (last >= 0) h.right[last] = f.t[i];
      if (last < 0 || h.level[last] !== f.level[i] || h.reason[last] !== f.reason[i]) {
        h.left.push(f.t[i]); h.right.push(f.t[i]); h.level.push(f.level[i]);
        h.name.push(LEVELS[f.level[i]]); h.reason.push(f.reason[i]);
        h.colour.push(COLOURS[f.level[i]]);
      }
    }
    source('health').data = h;
  }

  function listen() {
    const socket = new WebSocket(`ws://${location.host}/messages`);
    socket.onmessage = e => take(JSON.parse(e.data));
    socket.onclose = () => {
      by('state').textContent = 'No connection to rlml view; trying again every 2 s.';
      setTimeout(listen, 2000);
    };
  }

  // --- begin -----------------------------------------------------------------------------------

  function unpackScans() {
    const { t, count } = source('scans').data, { x, y } = source('points').data;
    let from = 0;
    for (let i = 0; i < t.length; i++) {
      scans.push({ t: t[i], x: x.slice(from, from + count[i]), y: y.slice(from, from + count[i]) });
      from += count[i];
    }
  }

  function begin() {
    cursors = [...doc._all_models.values()].filter(m => m.tags?.includes('cursor'));
    times = views().find(v => v.model.name === 'health').model.x_range;
    unpackScans();
    layers();
    paper();
    hideEmpty();
    by('slider').oninput = e => { play(false); follow(false); show(+e.target.value); };
    by('play').onclick = () => isLive ? follow(!follows) : play(!playing);
    map.on_event('tap', e => seekPlace(e.x, e.y));
    for (const m of doc._all_models.values()) {
      if (m.type === 'Figure' && m !== map) {
        m.on_event('tap', e => { follow(false); seek(e.x); });
        // a finger scrolls the page; the tools of a plot are switched on in its tool bar
        if (matchMedia('(pointer: coarse)').matches) {
          for (const tool of m.toolbar.tools) if ('active' in tool && tool.type !== 'HoverTool') tool.active = false;
        }
      }
    }
    for (const side of ['inner_width', 'inner_height']) {
      map.properties[side].change.connect(() => requestAnimationFrame(toScale));
    }
    for (const event of ['pan', 'wheel', 'pinch']) map.on_event(event, () => { touched = true; });
    map.on_event('reset', () => { touched = false; toScale(); });
    label();
    const asked = /^#t=([\d.]+)$/.exec(location.hash);
    if (asked) seek(+asked[1]); else show(0);
    toScale();
    window.viewer = {
      ready: true, show, seek, take, map, source, messages: 0, latency: NaN,
      cursors: () => cursors, figures: () => views().filter(v => v.model.type === 'Figure').map(v => v.model.name), element, tooltips,
    };
    if (isLive) listen();
  }

  /** For tests: where a figure is, and what the tooltips say. */
  const views = () => [...Bokeh.index];
  const element = name => views().find(v => v.model.name === name).el;
  const tooltips = () => [...document.querySelectorAll('.bk-Tooltip')].map(
    e => e.shadowRoot.textContent).join(' ');

  const wait = () => {
    doc = window.Bokeh?.documents?.[0];
    map = doc?.get_model_by_name('map');
    if (map && document.querySelector('.map > *')) begin(); else requestAnimationFrame(wait);
  };
  wait();
})();
