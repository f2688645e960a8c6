"use strict";
// The three planes share one point: moving one slice slider moves that coordinate, a click in a picture moves the other two.
(() => {
  const stacks = JSON.parse(document.getElementById("stacks").textContent);
  const parts = stacks.map((stack) => {
    const figure = document.getElementById("stack-" + stack.name);
    const pick = (kind) => figure.querySelector("." + kind);
    return { stack, slider: pick("position"), output: pick("millimetres"), canvas: pick("canvas"),
             fixed: pick("fixed"), moving: pick("moving"), lines: pick("lines") };
  });
  const letters = ["RL", "AP", "SI"];
  const inWords = (axis, mm) => Math.abs(mm).toFixed(1) + " mm " + letters[axis][mm >= 0 ? 0 : 1];

  function show(part) {
    const { stack } = part, n = Number(part.slider.value);
    part.fixed.src = stack.fixed[n];
    part.moving.src = stack.moving[n];
    part.lines.src = stack.lines[n];
    part.output.textContent = inWords(stack.axis, stack.positions[n]);
    part.slider.setAttribute("aria-valuetext", part.output.textContent);
  }
  function moveTo(axis, mm) {
    const part = parts.find((p) => p.stack.axis === axis);
    const away = part.stack.positions.map((p) => Math.abs(p - mm));
    part.slider.value = away.indexOf(Math.min(...away));
    show(part);
  }
  for (const part of parts) {
    part.slider.addEventListener("input", () => show(part));
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
  const blend = document.getElementById("blend"), shown = document.getElementById("blend-shown");
  function mix() {
    for (const part of parts) part.moving.style.opacity = blend.value / 100;
    shown.textContent = blend.value + " %";
  }
  blend.addEventListener("input", mix);
  mix();
  document.getElementById("outlines").addEventListener("change", (event) => {
    for (const part of parts) part.lines.style.visibility = event.target.checked ? "visible" : "hidden";
  });
  document.getElementById("to-nodule").addEventListener("click", () => {
    for (const part of parts) { part.slider.value = part.stack.start; show(part); }
  });
})();
