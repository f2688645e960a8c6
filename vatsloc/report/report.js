"use strict";
// The three planes share one point: moving one slice slider moves that coordinate, a click in a picture moves the other
// two. What the sliders say can stand in the address, as in #blend=60&deform=50&turn=30&tilt=15.
(() => {
  const scene = decoded(JSON.parse(document.getElementById("scene").textContent));
  const parts = scene.stacks.map((stack) => {
    const figure = document.getElementById("stack-" + stack.name);
    const pick = (kind) => figure.querySelector("." + kind);
    return { stack, slider: pick("position"), output: pick("millimetres"), canvas: pick("canvas"),
             fixed: pick("fixed"), moving: pick("moving"), lines: pick("lines") };
  });
  const letters = ["RL", "AP", "SI"];
  const inWords = (axis, mm) => Math.abs(mm).toFixed(1) + " mm " + letters[axis][mm >= 0 ? 0 : 1];
  const byId = (id) => document.getElementById(id);
  const state = { blend: 0, deform: 100, turn: scene.look.turn, tilt: scene.look.tilt };
  const space = byId("space"), draw3d = space && lung3d(space, { ...scene.motion, landmarks: scene.landmarks, words: scene.words, nodule: scene.nodule });

  function decoded(data) {
    const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
    const surface = (s) => ({ ...s, points: new Float32Array(bytes(s.points)), triangles: new Uint32Array(bytes(s.triangles)) });
    if (data.motion) {
      const { points, triangles } = surface({ points: data.motion.after, triangles: data.motion.triangles });
      data.motion = { triangles, after: points, before: new Float32Array(bytes(data.motion.before)), wall: surface(data.motion.wall) };
    }
    return data;
  }
  function show(part) {
    const { stack } = part, n = Number(part.slider.value);
    part.fixed.src = stack.fixed[n];
    part.moving.src = stack.moving[n];
    part.output.textContent = inWords(stack.axis, stack.positions[n]);
    part.slider.setAttribute("aria-valuetext", part.output.textContent);
    outline(part);
  }
  // Line segments in which triangles meet the slice, drawn in the slice's pixels.
  function section(part, pen, points, triangles, colour) {
    const { axis, origin, right, down, positions } = part.stack, mm = positions[Number(part.slider.value)];
    const step = right.concat(down).reduce((sum, x) => sum + x * x, 0) / 2, zoom = part.lines.width / part.stack.columns;
    const column = right.findIndex((x) => x), row = down.findIndex((x) => x);
    pen.strokeStyle = colour;
    pen.beginPath();
    for (let t = 0; t < triangles.length; t += 3) {
      let ends = 0;
      for (let e = 0; e < 3; e++) {
        const i = 3 * triangles[t + e], j = 3 * triangles[t + ((e + 1) % 3)], hi = points[i + axis] - mm, hj = points[j + axis] - mm;
        if (hi < 0 === hj < 0) continue;
        const s = hi / (hi - hj), at = (a) => points[i + a] + s * (points[j + a] - points[i + a]) - origin[a];
        const x = ((at(column) * right[column]) / step + 0.5) * zoom, y = ((at(row) * down[row]) / step + 0.5) * zoom;
        if (ends++) pen.lineTo(x, y); else pen.moveTo(x, y);
      }
    }
    pen.stroke();
  }
  function outline(part) {
    const { stack, lines } = part, pen = lines.getContext("2d");
    const wide = Math.max(lines.clientWidth, 1) * Math.min(window.devicePixelRatio || 1, 2);
    lines.width = Math.round(wide);
    lines.height = Math.round((wide * stack.rows) / stack.columns);
    const zoom = lines.width / stack.columns, share = state.deform / 100;
    pen.lineWidth = Math.max(1.5, lines.width / 260);
    if (scene.motion) {
      const { before, after, triangles, wall } = scene.motion;
      const now = new Float32Array(before.length);
      for (let n = 0; n < now.length; n++) now[n] = before[n] + share * (after[n] - before[n]);
      pen.setLineDash([6, 5]);
      section(part, pen, wall.points, wall.triangles, scene.colours.wall);
      pen.setLineDash([]);
      section(part, pen, now, triangles, scene.colours.lung);
    }
    const { after, ellipsoid } = scene.nodule, before = scene.nodule.before || after;
    const centre = after.map((x, a) => before[a] + share * (x - before[a]));
    pen.strokeStyle = pen.fillStyle = scene.colours.nodule;
    pen.lineWidth = Math.max(2, lines.width / 180);
    if (ellipsoid) oval(part, pen, centre, ellipsoid, zoom);
    const mm = stack.positions[Number(part.slider.value)], step = Math.hypot(...stack.right);
    if (Math.abs(centre[stack.axis] - mm) > Math.max(2, step)) return;
    const along = (v) => (v.reduce((sum, x, a) => sum + x * (centre[a] - stack.origin[a]), 0) / step ** 2 + 0.5) * zoom;
    const x = along(stack.right), y = along(stack.down), arm = lines.width / 40;
    pen.beginPath(); pen.arc(x, y, arm / 4, 0, 7); pen.fill();
    pen.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + dx * arm * 1.4, y + dy * arm * 1.4); pen.lineTo(x + dx * arm * 2.4, y + dy * arm * 2.4);
    }
    pen.stroke();
  }
  // The ellipse in which the slice cuts { c + A s : |s| = 1 }, rows of A the semi-axes: slicing the unit sphere instead.
  function oval(part, pen, centre, axes, zoom) {
    const { axis, origin, right, down, positions } = part.stack, step = Math.hypot(...right) ** 2;
    const normal = axes.map((row) => row[axis]), length = Math.hypot(...normal);
    const off = (positions[Number(part.slider.value)] - centre[axis]) / length;
    if (Math.abs(off) >= 1) return;
    const n = normal.map((x) => x / length), least = n.map(Math.abs).indexOf(Math.min(...n.map(Math.abs)));
    const e = [0, 1, 2].map((a) => (a === least ? 1 : 0) - n[a] * n[least]), size = Math.hypot(...e);
    const u = e.map((x) => x / size), v = [n[1] * u[2] - n[2] * u[1], n[2] * u[0] - n[0] * u[2], n[0] * u[1] - n[1] * u[0]];
    const r = Math.sqrt(1 - off * off);
    pen.beginPath();
    for (let q = 0; q <= 64; q++) {
      const a = (q * Math.PI) / 32, s = [0, 1, 2].map((b) => off * n[b] + r * (Math.cos(a) * u[b] + Math.sin(a) * v[b]));
      const at = [0, 1, 2].map((b) => centre[b] + axes[0][b] * s[0] + axes[1][b] * s[1] + axes[2][b] * s[2] - origin[b]);
      const along = (d) => ((at[0] * d[0] + at[1] * d[1] + at[2] * d[2]) / step + 0.5) * zoom;
      pen.lineTo(along(right), along(down));
    }
    pen.stroke();
  }
  function moveTo(axis, mm) {
    const part = parts.find((p) => p.stack.axis === axis);
    const away = part.stack.positions.map((p) => Math.abs(p - mm));
    part.slider.value = away.indexOf(Math.min(...away));
    show(part);
  }
  let waiting = false, resting = 0;
  function refresh() {
    byId("blend").value = state.blend;
    byId("blend-shown").textContent = state.blend + " %";
    for (const part of parts) { part.moving.style.opacity = state.blend / 100; outline(part); }
    if (!space) return;
    byId("deform").value = state.deform;
    byId("deform-shown").textContent = state.deform + " %";
    if (waiting) return;
    waiting = true;
    clearTimeout(resting);
    requestAnimationFrame(() => { waiting = false; paint(true); resting = setTimeout(paint, 100); });
  }
  function paint(coarse) { if (space) draw3d({ ...state, deform: state.deform / 100 }, coarse === true); }
  function set(changes) {
    Object.assign(state, changes);
    state.tilt = Math.max(-89, Math.min(89, state.tilt));
    refresh();
  }
  function fromAddress() {
    const asked = new URLSearchParams(location.hash.slice(1)), changes = {};
    for (const name of Object.keys(state)) if (asked.has(name) && Number.isFinite(+asked.get(name))) changes[name] = +asked.get(name);
    for (const name of ["blend", "deform"]) if (name in changes) changes[name] = Math.max(0, Math.min(100, changes[name]));
    set(changes);
  }
  for (const part of parts) {
    part.slider.addEventListener("input", () => show(part));
    part.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      part.slider.value = Number(part.slider.value) + Math.sign(event.deltaY);
      show(part);
    }, { passive: false });
    part.canvas.addEventListener("click", (event) => {
      const { stack } = part, frame = part.canvas.getBoundingClientRect();
      const column = ((event.clientX - frame.left) / frame.width) * stack.columns - 0.5;
      const row = ((event.clientY - frame.top) / frame.height) * stack.rows - 0.5;
      for (let axis = 0; axis < 3; axis++) {
        if (axis !== stack.axis) moveTo(axis, stack.origin[axis] + column * stack.right[axis] + row * stack.down[axis]);
      }
    });
    show(part);
  }
  byId("blend").addEventListener("input", (event) => set({ blend: +event.target.value }));
  byId("outlines").addEventListener("change", (event) => {
    for (const part of parts) part.lines.style.visibility = event.target.checked ? "visible" : "hidden";
  });
  byId("to-nodule").addEventListener("click", () => {
    for (const part of parts) { part.slider.value = part.stack.start; show(part); }
  });
  if (space) {
    byId("deform").addEventListener("input", (event) => set({ deform: +event.target.value }));
    let held = null;
    space.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; space.setPointerCapture(event.pointerId); });
    space.addEventListener("pointerup", () => { held = null; });
    space.addEventListener("pointermove", (event) => {
      if (!held) return;
      set({ turn: state.turn - (event.clientX - held[0]) / 2, tilt: state.tilt + (event.clientY - held[1]) / 2 });
      held = [event.clientX, event.clientY];
    });
    space.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: { turn: state.turn + 10 }, ArrowRight: { turn: state.turn - 10 },
                     ArrowUp: { tilt: state.tilt + 10 }, ArrowDown: { tilt: state.tilt - 10 } }[event.key];
      if (step) { event.preventDefault(); set(step); }
    });
    for (const button of document.querySelectorAll("[data-turn]")) {
      button.addEventListener("click", () => set({ turn: +button.dataset.turn, tilt: +button.dataset.tilt }));
    }
  }
  addEventListener("hashchange", fromAddress);
  addEventListener("resize", refresh);
  fromAddress();
  paint();
})();
