"use strict";
// The lung in three dimensions, drawn by a rasterizer of its own: it needs no graphics card and looks alike everywhere.
const STEPS = 2, FINEST = 120000; // subdivisions at most, triangles at most
function lung3d(canvas, scene) {
  const pen = canvas.getContext("2d");
  const { wall: border, nodule } = scene;
  // The mesh is coarse, its rim a polygon: a smooth surface is drawn through it.
  const { triangles, values: [before, after] } = smooth(scene.triangles, [scene.before, scene.after]);
  const now = new Float32Array(before.length);
  const lung = mesh(now, triangles), wall = mesh(border.points, border.triangles), ball = sphere();
  const ORANGE = [230, 159, 0], YELLOW = [240, 228, 66], BLUE = [86, 180, 233], GREY = [190, 200, 215];
  const BALL = [[4, 0, 0], [0, 4, 0], [0, 0, 4]];
  const middle = [0, 0, 0];
  let low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
  for (let n = 0; n < border.points.length; n++) {
    low[n % 3] = Math.min(low[n % 3], border.points[n]);
    high[n % 3] = Math.max(high[n % 3], border.points[n]);
  }
  for (let a = 0; a < 3; a++) middle[a] = (low[a] + high[a]) / 2;
  const radius = Math.hypot(...middle.map((m, a) => high[a] - m));

  // Loop's subdivision (1987) of a closed surface, the same for every array of points.
  function smooth(corners, values) {
    for (let n = 0; n < STEPS && 4 * corners.length <= 3 * FINEST; n++) [corners, values] = subdivided(corners, values);
    return { triangles: corners, values };
  }
  function subdivided(corners, values) {
    const n = values[0].length / 3, edges = new Map(), across = [], ends = [];
    const sum = values.map((v) => new Float64Array(v.length)), degree = new Uint16Array(n);
    const edge = (a, b, opposite) => {
      const key = a < b ? a * n + b : b * n + a;
      let e = edges.get(key);
      if (e === undefined) { e = ends.length; edges.set(key, e); ends.push([a, b]); across.push([]); }
      across[e].push(opposite);
      return n + e;
    };
    const finer = new Uint32Array(4 * corners.length);
    for (let t = 0; t < corners.length; t += 3) {
      const [a, b, c] = corners.subarray(t, t + 3), ab = edge(a, b, c), bc = edge(b, c, a), ca = edge(c, a, b);
      finer.set([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 4 * t);
    }
    for (const [a, b] of ends) {
      degree[a]++; degree[b]++;
      values.forEach((v, m) => { for (let x = 0; x < 3; x++) { sum[m][3 * a + x] += v[3 * b + x]; sum[m][3 * b + x] += v[3 * a + x]; } });
    }
    return [finer, values.map((v, m) => {
      const out = new Float32Array(3 * (n + ends.length));
      for (let p = 0; p < n; p++) {
        const k = Math.max(degree[p], 1), beta = (5 / 8 - (3 / 8 + Math.cos((2 * Math.PI) / k) / 4) ** 2) / k;
        for (let x = 0; x < 3; x++) out[3 * p + x] = (1 - k * beta) * v[3 * p + x] + beta * sum[m][3 * p + x];
      }
      ends.forEach(([a, b], e) => { for (let x = 0; x < 3; x++) {
        const middle = v[3 * a + x] + v[3 * b + x], [c, d] = across[e];
        out[3 * (n + e) + x] = d === undefined ? middle / 2 : (3 * middle + v[3 * c + x] + v[3 * d + x]) / 8;
      } });
      return out;
    })];
  }
  function mesh(points, corners) {
    return { points, corners, normals: new Float32Array(points.length), screen: new Float32Array(points.length),
             facing: new Float32Array(points.length / 3), light: new Float32Array(points.length / 3) };
  }
  function sphere() {
    const points = [], corners = [], rings = 12, sectors = 24;
    for (let r = 0; r <= rings; r++) for (let s = 0; s < sectors; s++) {
      const a = (Math.PI * r) / rings, b = (2 * Math.PI * s) / sectors;
      points.push(Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a));
    }
    for (let r = 0; r < rings; r++) for (let s = 0; s < sectors; s++) {
      const a = r * sectors + s, b = r * sectors + ((s + 1) % sectors);
      corners.push(a, a + sectors, b, b, a + sectors, b + sectors);
    }
    return { points, corners: new Uint32Array(corners) };
  }
  function ellipsoid(centre, axes) {
    const flip = dot(cross(axes[0], axes[1]), axes[2]) < 0 ? -1 : 1;
    const points = new Float32Array(ball.points.length);
    for (let n = 0; n < points.length; n += 3) for (let a = 0; a < 3; a++)
      points[n + a] = centre[a] + flip * axes[0][a] * ball.points[n] + axes[1][a] * ball.points[n + 1] + axes[2][a] * ball.points[n + 2];
    return mesh(points, ball.corners);
  }
  function normalsOf({ points, corners, normals }) {
    normals.fill(0);
    for (let t = 0; t < corners.length; t += 3) {
      const [i, j, k] = [3 * corners[t], 3 * corners[t + 1], 3 * corners[t + 2]];
      const ux = points[j] - points[i], uy = points[j + 1] - points[i + 1], uz = points[j + 2] - points[i + 2];
      const vx = points[k] - points[i], vy = points[k + 1] - points[i + 1], vz = points[k + 2] - points[i + 2];
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      for (const at of [i, j, k]) { normals[at] += nx; normals[at + 1] += ny; normals[at + 2] += nz; }
    }
    for (let n = 0; n < normals.length; n += 3) {
      const length = Math.hypot(normals[n], normals[n + 1], normals[n + 2]) || 1;
      for (let a = 0; a < 3; a++) normals[n + a] /= length;
    }
  }
  // turn: degrees about the head-foot axis, 0 looks from the front; tilt: degrees from above.
  function camera(turn, tilt, width, height) {
    const t = (turn * Math.PI) / 180, e = (tilt * Math.PI) / 180;
    const right = [-Math.cos(t), -Math.sin(t), 0], back = [-Math.sin(t) * Math.cos(e), Math.cos(t) * Math.cos(e), Math.sin(e)];
    const up = cross(back, right), scale = (0.48 * Math.min(height, 1.25 * width)) / radius * 1.12;
    const light = [0, 1, 2].map((a) => 0.8 * back[a] + 0.45 * up[a] - 0.4 * right[a]);
    return { right, up, back, light, scale, project: (p) => {
      const d = p.map((x, a) => x - middle[a]);
      return [width / 2 + scale * dot(d, right), height / 2 - scale * dot(d, up), dot(d, back)];
    } };
  }
  function onScreen(part, view, width, height) {
    const { points, normals, screen, facing, light } = part, { right: r, up: u, back: b, light: l, scale } = view;
    for (let n = 0, m = 0; n < points.length; n += 3, m++) {
      const x = points[n] - middle[0], y = points[n + 1] - middle[1], z = points[n + 2] - middle[2];
      screen[n] = width / 2 + scale * (x * r[0] + y * r[1] + z * r[2]);
      screen[n + 1] = height / 2 - scale * (x * u[0] + y * u[1] + z * u[2]);
      screen[n + 2] = x * b[0] + y * b[1] + z * b[2];
      facing[m] = normals[n] * b[0] + normals[n + 1] * b[1] + normals[n + 2] * b[2];
      light[m] = normals[n] * l[0] + normals[n + 1] * l[1] + normals[n + 2] * l[2];
    }
  }
  // Nearest surface of a part at every pixel: depth towards the eye, how far it faces the eye, how far the light.
  function nearest(part, width, height) {
    const depth = new Float32Array(width * height).fill(-Infinity);
    const facing = new Float32Array(width * height), light = new Float32Array(width * height);
    const { corners, screen: s } = part;
    for (let t = 0; t < corners.length; t += 3) {
      const a = corners[t], b = corners[t + 1], c = corners[t + 2], i = 3 * a, j = 3 * b, k = 3 * c;
      const area = (s[j] - s[i]) * (s[k + 1] - s[i + 1]) - (s[k] - s[i]) * (s[j + 1] - s[i + 1]);
      if (area >= 0) continue;
      const x0 = Math.max(0, Math.ceil(Math.min(s[i], s[j], s[k]))), x1 = Math.min(width - 1, Math.floor(Math.max(s[i], s[j], s[k])));
      const y0 = Math.max(0, Math.ceil(Math.min(s[i + 1], s[j + 1], s[k + 1]))), y1 = Math.min(height - 1, Math.floor(Math.max(s[i + 1], s[j + 1], s[k + 1])));
      for (let y = y0; y <= y1; y++) for (let x = x0; x <= x1; x++) {
        const wb = ((x - s[i]) * (s[k + 1] - s[i + 1]) - (s[k] - s[i]) * (y - s[i + 1])) / area;
        const wc = ((s[j] - s[i]) * (y - s[i + 1]) - (x - s[i]) * (s[j + 1] - s[i + 1])) / area;
        if (wb < 0 || wc < 0 || wb + wc > 1) continue;
        const wa = 1 - wb - wc, z = wa * s[i + 2] + wb * s[j + 2] + wc * s[k + 2], at = y * width + x;
        if (z <= depth[at]) continue;
        depth[at] = z;
        facing[at] = Math.max(wa * part.facing[a] + wb * part.facing[b] + wc * part.facing[c], 0);
        light[at] = Math.max(wa * part.light[a] + wb * part.light[b] + wc * part.light[c], 0);
      }
    }
    return { depth, facing, light };
  }
  const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
  function cross(p, q) {
    return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
  }
  const mix = (p, q, share) => p.map((x, a) => x + share * (q[a] - x));

  normalsOf(wall);
  // coarse: while the view moves; else two pixels for each on the screen, so that rims are not jagged.
  return function draw({ deform, turn, tilt }, coarse) {
    const fine = coarse ? Math.min(window.devicePixelRatio || 1, 2) : 2;
    const width = (canvas.width = Math.round(canvas.clientWidth * fine)), height = (canvas.height = Math.round(canvas.clientHeight * fine));
    if (!width || !height) return;
    for (let n = 0; n < now.length; n++) now[n] = before[n] + deform * (after[n] - before[n]);
    normalsOf(lung);
    const view = camera(turn, tilt, width, height);
    const centre = mix(nodule.before, nodule.after, deform);
    const start = ellipsoid(nodule.before, BALL), end = ellipsoid(centre, BALL), unsure = nodule.ellipsoid && ellipsoid(centre, nodule.ellipsoid);
    for (const part of [start, end, unsure]) if (part) normalsOf(part);
    const [wallSeen, lungSeen, startSeen, endSeen, unsureSeen] = [wall, lung, start, end, unsure].map((part) => {
      if (!part) return null;
      onScreen(part, view, width, height);
      return nearest(part, width, height);
    });
    const image = pen.createImageData(width, height), rgb = image.data;
    new Uint32Array(rgb.buffer).fill(new Uint32Array(new Uint8Array([22, 26, 32, 255]).buffer)[0]);
    const over = (p, colour, light, alpha) => {
      for (let c = 0, at = 4 * p; c < 3; c++, at++) rgb[at] += alpha * (Math.min(colour[c] * light, 255) - rgb[at]);
    };
    const solid = (seen, p, colour) => { if (seen.depth[p] > -Infinity) over(p, colour, 0.4 + 0.65 * seen.light[p], 1); };
    const glass = (seen, p, colour, least, rim) => {
      if (seen.depth[p] > -Infinity) over(p, colour, 0.35 + 0.75 * seen.light[p], least + rim * (1 - seen.facing[p]) ** 2);
    };
    for (let p = 0; p < width * height; p++) {
      const ball = Math.max(startSeen.depth[p], endSeen.depth[p]);
      glass(lungSeen, p, ORANGE, 0.6, 0.35);
      if (startSeen.depth[p] < endSeen.depth[p]) solid(startSeen, p, BLUE);
      solid(endSeen, p, YELLOW);
      if (startSeen.depth[p] >= endSeen.depth[p]) solid(startSeen, p, BLUE);
      if (ball > -Infinity && lungSeen.depth[p] > ball) glass(lungSeen, p, ORANGE, 0.15, 0);
      if (unsureSeen) glass(unsureSeen, p, YELLOW, 0.12, 0.5);
      glass(wallSeen, p, GREY, 0.04, 0.35);
    }
    pen.putImageData(image, 0, 0);
    marks(view, centre, fine, deform);
  };

  function marks(view, centre, fine, deform) {
    pen.lineWidth = 1.5 * fine;
    pen.font = `600 ${12.5 * fine}px system-ui, sans-serif`;
    pen.textBaseline = "middle";
    const write = (words, [x, y], dx, dy) => {
      const wide = pen.measureText(words).width, left = Math.min(Math.max(x + dx * fine, 4), canvas.width - wide - 4);
      pen.strokeStyle = "#000c"; pen.lineWidth = 3 * fine; pen.strokeText(words, left, y + dy * fine);
      pen.fillStyle = "#fff"; pen.fillText(words, left, y + dy * fine);
    };
    const line = (from, to, colour, dash) => {
      pen.setLineDash(dash.map((d) => d * fine)); pen.strokeStyle = colour; pen.lineWidth = 2 * fine;
      pen.beginPath(); pen.moveTo(from[0], from[1]); pen.lineTo(to[0], to[1]); pen.stroke(); pen.setLineDash([]);
    };
    const first = view.project(nodule.before), last = view.project(centre);
    line(first, last, "#56b4e9", [5, 4]);
    if (deform === 1) {
      if (nodule.foot) line(last, view.project(nodule.foot), "#fff", []);
      pen.fillStyle = "#fff";
      for (const { name, at } of scene.landmarks) {
        const p = view.project(at);
        pen.beginPath(); pen.arc(p[0], p[1], 3 * fine, 0, 7); pen.fill();
        write(name, p, 7, 0);
      }
    }
    if (Math.hypot(first[0] - last[0], first[1] - last[1]) > 40 * fine) write(scene.words.inflated, first, 11, 0);
    write(scene.words.nodule, last, 11, last[1] > first[1] ? 16 : -16);
    const corner = [34 * fine, canvas.height - 34 * fine];
    for (const [axis, letter, opposite] of [[0, "R", "L"], [1, "A", "P"], [2, "S", "I"]]) {
      const dx = view.right[axis], dy = -view.up[axis], long = 20 * fine;
      if (Math.hypot(dx, dy) < 0.25) continue;
      // RAS axes point to the right, front and head: R is the patient's right.
      line(corner, [corner[0] + dx * long, corner[1] + dy * long], "#c9ced6", []);
      write(letter, [corner[0] + dx * 1.45 * long - 4 * fine, corner[1] + dy * 1.45 * long], 0, 0);
    }
  }
}
