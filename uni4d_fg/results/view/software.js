// What viser draws at a cost that only software feels. With a graphics card, and where a name that this relies on is not
// found, everything is drawn as viser does.
//
// Lines are instances of a small mesh, and software draws every instance by itself, which took two thirds of a picture
// with trails. Here their vertex shader is replaced by one that takes the ends as they lie in viser's buffers, one after
// the other, as WebGL's own lines do. Those are a pixel wide: copies beside each other make up for it, but not for many
// while the picture changes.
//
// An image behind the scene is drawn over the whole picture and discarded pixel by pixel where there is none.
(() => {
  if (window.uni4dSoftware || !window.WebGL2RenderingContext) return;
  const state = (window.uni4dSoftware = { shaders: 0, drawn: 0, behind: 0 });
  const gl2 = WebGL2RenderingContext.prototype, drawCopies = gl2.drawArraysInstanced;
  const shaders = new WeakSet(), programs = new WeakMap(), widths = new WeakMap();
  const behind = new WeakMap(), shows = new WeakMap();
  const MAIN = "void main() {", BOTH_ENDS = 24, ONE_END = 12, FEW = 20;
  const NEEDED = [
    MAIN, "attribute vec3 instanceStart;", "attribute vec3 instanceColorStart;", "varying vec3 vLineColor;",
    "varying vec2 vUv;", "uniform float linewidth;", "uniform vec2 resolution;",
  ];
  const OTHER = /#define (WORLD_UNITS|USE_DASH|USE_LINE_COLOR_ALPHA|USE_LOGARITHMIC_DEPTH_BUFFER)\b/;
  const RATIO = Math.max(window.devicePixelRatio || 1, 1);
  // So many copies to the right and as many above are as wide as the line, whatever its direction.
  const aside = (width) => Math.max(Math.ceil(width * RATIO) - 1, 0);
  const OWN_MAIN = `
    void main() {
      #ifdef USE_COLOR
        vLineColor = instanceColorStart;
      #endif
      vUv = vec2(0.0);
      vec4 mvPosition = modelViewMatrix * vec4(instanceStart, 1.0);
      gl_Position = projectionMatrix * mvPosition;
      float wider = max(linewidth - ${(1 / RATIO).toFixed(4)}, 0.0);
      float part = float((gl_InstanceID + 1) / 2) / max(ceil(linewidth * ${RATIO.toFixed(4)}) - 1.0, 1.0);
      vec2 moved = gl_InstanceID % 2 == 1 ? vec2(part, 0.0) : vec2(0.0, part);
      gl_Position.xy += (moved - 0.5) * wider * 2.0 / resolution * gl_Position.w;
      #ifdef USE_FOG
        vFogDepth = -mvPosition.z;
      #endif
    }`;

  let program = null;
  const wrap = (name, make) => { const inner = gl2[name]; gl2[name] = make(inner); };
  wrap("shaderSource", (inner) => function (shader, text) {
    const viser = NEEDED.every((words) => text.includes(words)) && !OTHER.test(text);
    if (!viser || !window.uni4dDetail?.software) return inner.call(this, shader, text);
    shaders.add(shader);
    state.shaders += 1;
    return inner.call(this, shader, text.replace(MAIN, "void mainOfInstances() {") + OWN_MAIN);
  });
  wrap("attachShader", (inner) => function (owner, shader) {
    if (shaders.has(shader)) programs.set(owner, null);
    return inner.call(this, owner, shader);
  });
  wrap("useProgram", (inner) => function (next) { program = next; return inner.call(this, next); });
  wrap("getUniformLocation", (inner) => function (owner, name) {
    const place = inner.call(this, owner, name);
    if (place && name === "linewidth" && programs.has(owner)) { programs.set(owner, place); widths.set(place, 1); }
    if (place && name === "enabled" && inner.call(this, owner, "depthMap")) { behind.set(owner, place); shows.set(place, true); }
    return place;
  });
  wrap("uniform1i", (inner) => function (place, value) {
    if (place && shows.has(place)) shows.set(place, Boolean(value));
    return inner.call(this, place, value);
  });
  wrap("drawElements", (inner) => function (...rest) {
    if (window.uni4dDetail?.software && shows.get(behind.get(program)) === false) { state.behind += 1; return; }
    inner.apply(this, rest);
  });
  wrap("uniform1f", (inner) => function (place, value) {
    if (place && widths.has(place)) widths.set(place, value);
    return inner.call(this, place, value);
  });
  wrap("vertexAttribPointer", (inner) => function (place, size, type, normalized, stride, offset) {
    const own = programs.has(program) && stride === BOTH_ENDS ? ONE_END : stride;
    return inner.call(this, place, size, type, normalized, own, offset);
  });
  wrap("vertexAttribDivisor", (inner) => function (place, divisor) {
    return inner.call(this, place, programs.has(program) ? 0 : divisor);
  });
  wrap("drawElementsInstanced", (inner) => function (mode, count, type, offset, instances) {
    if (!programs.has(program)) return inner.call(this, mode, count, type, offset, instances);
    state.drawn += instances;
    const thin = instances > FEW && window.uni4dDetail.moving;
    const copies = thin ? 0 : 2 * aside(widths.get(programs.get(program)) ?? 1);
    return drawCopies.call(this, this.LINES, 0, 2 * instances, 1 + copies);
  });
})();
