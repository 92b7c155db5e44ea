// Level of detail for point clouds that are drawn in a page of viser, which draws every point every time.
//
// Clouds come in chunks whose points are ordered so that any first part of them covers the chunk evenly
// (uni4d_fg/results/chunks.py). Here less of a chunk is drawn where its points are smaller than a pixel or the
// chunk is out of sight, and, while the picture changes, as much as the machine draws at the wanted rate; what is left
// out is made up for by larger points. A picture that stands still gets several times as much, and more every time it is
// drawn, up to what takes most of a second. Where a name that this relies on is not found, everything is drawn.
//
// Software draws a picture while the one before it is shown, so that what a key asks for waits for one or two of them:
// it aims at a higher rate. Few large points cost it as much as many small ones, so that below the fewest points that
// still show a scene, these get smaller. viser draws for a quarter of a second after whatever it is asked for, and once a
// second in any case: a picture that would be the same as the one before is left out, which leaves that one in place, as
// a key would wait for it.
(() => {
  if (window.uni4dDetail || !window.WebGL2RenderingContext) return;
  const TARGET_MS = 43, SOFTWARE_MS = 27, TOUCH_MS = 300, QUIET_MS = 800, STILL_FACTOR = 6, STILL_MOST = 20, LEFT_OUT = 9;
  const FEWEST = 6000, MOST = 2e7, SMALL = 3000, LARGEST_PX = 24, SMALLEST_PX = 6;
  const state = (window.uni4dDetail = {
    budget: 60000, wanted: 0, drawn: 0, frames: 0, milliseconds: TARGET_MS, everything: false, circles: 0,
    software: null, moving: true, seen: false,
  });
  // Without a graphics card, smoothing of edges costs more than everything else; points have none. What draws is asked
  // of a canvas made for it, at once: making the first one takes software half a second, in which the page is read.
  const getContext = HTMLCanvasElement.prototype.getContext;
  let first = getContext.call(document.createElement("canvas"), "webgl2");
  first?.flush();
  const isSoftware = () => {
    const info = first?.getExtension("WEBGL_debug_renderer_info");
    const name = first ? String(first.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : first.RENDERER)) : "";
    first?.getExtension("WEBGL_lose_context")?.loseContext();
    first = null;
    return /swiftshader|llvmpipe|software|basic render/i.test(name);
  };
  HTMLCanvasElement.prototype.getContext = function (kind, options, ...rest) {
    if (kind !== "webgl2" || !options?.antialias) return getContext.call(this, kind, options, ...rest);
    state.software ??= isSoftware();
    return getContext.call(this, kind, { ...options, antialias: !state.software }, ...rest);
  };

  const gl2 = WebGL2RenderingContext.prototype;
  const target = () => (state.software ? SOFTWARE_MS : TARGET_MS);
  const SWIFT = ["SetSceneNodeVisibilityMessage", "GuiUpdateMessage"];
  const NAMES = ["scale", "modelViewMatrix", "projectionMatrix"];
  const located = new WeakMap(), values = new WeakMap();
  let program = null, still = 0, asked = 0, shown = 0, moving = false, begun = false, before = 0, drewBefore = false;
  let touched = -1e9, changing = -1e9, last = -1e9, answered = true, settled = false, learned = false;
  let decided = false, skip = false, skipped = 0, size = "", news = true, listens = false, queued = false;
  let calls = 0, callsBefore = 0;

  const wrap = (name, make) => { const inner = gl2[name]; gl2[name] = make(inner); return inner; };
  wrap("useProgram", (inner) => function (next) { program = next; return inner.call(this, next); });
  wrap("getUniformLocation", (inner) => function (owner, name) {
    const place = inner.call(this, owner, name);
    if (place && NAMES.includes(name)) {
      if (!located.has(owner)) located.set(owner, {});
      located.get(owner)[name] = place;
      values.set(place, null);
    }
    return place;
  });
  // viser's points have any shape, by three powers a pixel, and may be shaded, which together are most of what software
  // does; ours are flat circles.
  const POWERS = /float r = pow\([^;]*1\.0 \/ point_ball_norm\);/, SHADES = /if \(point_shading_enabled > 0\.5\) \{[^}]*\}/;
  wrap("shaderSource", (inner) => function (shader, text) {
    if (!POWERS.test(text)) return inner.call(this, shader, text);
    state.circles += SHADES.test(text);
    return inner.call(this, shader, text.replace(POWERS, "float r = length(gl_PointCoord - vec2(0.5));").replace(SHADES, ""));
  });
  const setNumber = wrap("uniform1f", (inner) => function (place, value) {
    if (place && values.has(place)) values.set(place, value);
    return inner.call(this, place, value);
  });
  wrap("uniformMatrix4fv", (inner) => function (place, transpose, data, ...rest) {
    if (place && values.has(place)) values.set(place, Float32Array.from(data));
    return inner.call(this, place, transpose, data, ...rest);
  });

  // How much of a chunk there is to see: 0 out of sight, 1 where its points are a pixel or more apart.
  const worth = (view, projection, scale) => {
    const radius = 1.8 * Math.hypot(view[0], view[1], view[2]), depth = -view[14];
    if (depth < -radius) return 0;
    for (const [axis, focal] of [[12, projection[0]], [13, projection[5]]])
      if (Math.abs(view[axis]) * focal - depth > radius * Math.hypot(focal, 1)) return 0;
    const pixels = scale / Math.max(depth - radius, 1e-6);
    return Math.min(1, pixels * pixels);
  };
  // Whether a picture is left out, asked before anything of it is drawn: where it would be the same as the last one, and
  // not before it has been learned how long pictures take.
  const leftOut = (gl) => {
    if (decided) return skip;
    decided = true;
    const now = performance.now(), here = `${gl.drawingBufferWidth} ${gl.drawingBufferHeight}`, soon = now - last < QUIET_MS;
    const idle = soon ? listens && learned && now - changing > TOUCH_MS : settled && answered && skipped < LEFT_OUT;
    skip = state.software === true && !state.everything && !news && here === size && idle;
    if (!soon) { skipped = skip ? skipped + 1 : 0; if (skip) last = now; }
    // viser draws once a second when nothing changes, and more often when something does: by hand, or as the time goes on.
    moving = news || drewBefore || !answered || now - touched < TOUCH_MS || soon;
    state.moving = moving && !state.everything;
    news = queued = false; size = here;
    return skip;
  };
  // What a picture would show is told by what is asked to be drawn.
  const noted = (number) => { calls = (31 * calls + number) | 0; };
  for (const name of ["clear", "drawElements", "drawElementsInstanced", "drawArraysInstanced"])
    wrap(name, (inner) => function (...rest) {
      if (name !== "clear") noted(rest[1] + (rest[4] ?? 0));
      if (!leftOut(this)) inner.apply(this, rest);
    });
  wrap("drawArrays", (inner) => function (mode, first, count) {
    noted(count);
    if (leftOut(this)) return;
    state.seen ||= mode === this.POINTS;
    const places = mode === this.POINTS && count > SMALL && !state.everything && program && located.get(program);
    const [scale, view, projection] = places ? NAMES.map((name) => values.get(places[name])) : [];
    if (!scale || !view || !projection) return inner.call(this, mode, first, count);
    if (!begun) {
      begun = true;
      still = moving ? 0 : still + 1;
      last = performance.now(); answered = true;
    }
    const part = worth(view, projection, scale);
    if (part === 0) return;
    asked += part * count;
    const most = Math.max(state.budget, FEWEST), longer = TARGET_MS / target();
    const budget = moving ? most : Math.min(STILL_FACTOR * 2 ** (still - 1), STILL_MOST) * longer * most;
    const fraction = part * Math.min(1, budget / Math.max(state.wanted, 1));
    const number = Math.max(1, Math.ceil(fraction * count));
    shown += number;
    if (number >= count) return inner.call(this, mode, first, count);
    const depth = Math.max(-view[14], 1e-6), size = scale / depth;
    const largest = moving ? LARGEST_PX * Math.min(state.budget / FEWEST, 1) : LARGEST_PX;
    const larger = Math.max(size, Math.min(Math.max(size / Math.sqrt(number / count), 1), largest));
    setNumber.call(this, places.scale, larger * depth);
    inner.call(this, mode, first, number);
    setNumber.call(this, places.scale, scale);
  });

  for (const kind of ["pointerdown", "pointermove", "wheel", "keydown"])
    window.addEventListener(kind, (event) => {
      if (!event.buttons && kind.startsWith("pointer")) return;
      touched = performance.now(); answered = false;
      if (kind !== "keydown") changing = touched;
    }, true);
  // viser asks for a picture through an object that it shows to its own tests. What only shows, hides or tells is in the
  // very next picture; anything else may take several, as may what is asked for without a message.
  const listen = () => {
    const viser = window.__viserMutable, ask = viser?.requestRender;
    listens = Boolean(ask && viser.messageQueue);
    if (!listens || ask.listened) return;
    viser.requestRender = (...rest) => {
      const waiting = viser.messageQueue.length > 0;
      const swift = waiting ? viser.messageQueue.every(({ type }) => SWIFT.includes(type)) : queued;
      queued ||= waiting;
      news = true;
      if (!swift) changing = performance.now();
      return ask.apply(viser, rest);
    };
    viser.requestRender.listened = news = true;
  };
  const tick = (now) => {
    const drew = begun;
    if (drew) {
      settled = !moving && (shown >= asked || STILL_FACTOR * 2 ** (still - 1) >= STILL_MOST);
      state.wanted = asked; state.drawn = shown; state.frames += 1;
      asked = shown = 0;
      if (drewBefore && moving) {
        state.milliseconds += 0.3 * (Math.min(now - before, 500) - state.milliseconds);
        const ratio = target() / Math.max(state.milliseconds, 1);
        if (ratio < 0.9 || ratio > 1.1) state.budget *= Math.min(Math.max(ratio, 0.7), 1.1);
        const least = (FEWEST * SMALLEST_PX) / LARGEST_PX;
        learned = (ratio > 0.8 && ratio < 1.25) || (state.budget <= least && ratio < 1);
        state.budget = Math.min(Math.max(state.budget, least), MOST);
      }
    }
    // What came later than the picture that was asked for is in the next one.
    if (decided) { news ||= skip && calls !== callsBefore; callsBefore = calls; }
    calls = 0;
    begun = decided = skip = false;
    listen();
    drewBefore = drew; before = now;
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
})();
