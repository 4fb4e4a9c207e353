// The arm and its errors in three dimensions, on a canvas: no WebGL, so it works wherever the page does.
(() => {
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const canvas = document.getElementById("scene"), pen = canvas.getContext("2d");
  const stage = document.getElementById("scene-stage"), posture = document.getElementById("scene-posture");
  const longer = document.getElementById("scene-longer"), shorter = document.getElementById("scene-shorter");
  const own = document.getElementById("scene-own"), said = document.getElementById("scene-said");
  const start = { yaw: -0.9, pitch: 0.45, zoom: 1 };
  let view = { ...start }, stretch = 1;
  const turning = new Map();

  const size = (v) => Math.hypot(v[0], v[1], v[2]);
  const named = (key) => (pair) => ({ name: pair[0], [key]: pair[1] });
  const cloud = data.cloud || [], marks = data.marks.map(named("at")), lines = data.lines.map(named("path")), stages = data.stages.map(named("arrows"));
  const chosenStage = () => (stage ? stage.selectedIndex : 0);
  // local: the frame's origin may be far away, so the grid lies below what is shown
  const points = [...(data.local ? [] : [[0, 0, 0]]), ...data.points, ...data.arms.flat(2), ...cloud, ...marks.map((m) => m.at), ...lines.flatMap((l) => l.path)];
  const low = [0, 1, 2].map((k) => Math.min(...points.map((p) => p[k])));
  const high = [0, 1, 2].map((k) => Math.max(...points.map((p) => p[k])));
  const middle = low.map((a, k) => (a + high[k]) / 2);
  const radius = Math.max(1e-3, ...points.map((p) => size(p.map((v, k) => v - middle[k]))));
  const nice = (x) => { const p = 10 ** Math.floor(Math.log10(x)); return Number(([5, 2, 1].find((m) => m * p <= x) * p).toPrecision(1)); };
  const round = (x) => { const p = 10 ** Math.floor(Math.log10(x)); return Math.max(1, [1, 2, 5, 10].filter((m) => m * p <= x).pop() * p); };
  // a tenth of the picture for what 19 of 20 stay below
  const fitting = (k) => {
    const sizes = stages[k].arrows.map(size).sort((a, b) => a - b);
    return round(0.3 * radius / Math.max(1e-9, 1e-3 * (sizes[Math.floor(0.95 * sizes.length)] || 0)));
  };
  const scale = () => stretch * (stages.length ? fitting(own.checked ? chosenStage() : 0) : 1);

  function draw() {
    const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(`--${name}`).trim();
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = Math.round(ratio * width); canvas.height = Math.round(ratio * height);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = colour("paper"); pen.fillRect(0, 0, width, height);
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const unit = view.zoom * 0.46 * Math.min(width, height) / radius;
    const at = (p) => {
      const [x, y, z] = p.map((v, k) => v - middle[k]), side = cy * x - sy * y, deep = sy * x + cy * y;
      return [width / 2 + unit * side, height / 2 - unit * (cp * z + sp * deep)];
    };
    const line = (path, name, wide, dash = []) => {
      pen.strokeStyle = colour(name); pen.lineWidth = wide; pen.setLineDash(dash); pen.beginPath();
      path.map(at).forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y))); pen.stroke(); pen.setLineDash([]);
    };
    const dot = (p, name, r) => { pen.fillStyle = colour(name); pen.beginPath(); pen.arc(...at(p), r, 0, 7); pen.fill(); };
    const text = (p, words) => { const [x, y] = at(p); pen.fillStyle = colour("soft"); pen.fillText(words, x + 4, y - 3); };
    pen.font = "12px system-ui, sans-serif"; pen.lineCap = pen.lineJoin = "round";

    const step = nice(radius / 2), from = data.local ? [...middle.slice(0, 2).map((v) => step * Math.round(v / step)), low[2]] : [0, 0, 0];
    const off = (...by) => from.map((v, k) => v + by[k]);
    for (let k = -4; k <= 4; k++) {
      line([off(-4 * step, k * step, 0), off(4 * step, k * step, 0)], "line", 1);
      line([off(k * step, -4 * step, 0), off(k * step, 4 * step, 0)], "line", 1);
    }
    [["x", "bad"], ["y", "good"], ["z", "after"]].forEach(([name, tone], k) => {
      const end = [...from]; end[k] += 0.25 * radius; line([from, end], tone, 2); text(end, name);
    });
    lines.forEach((l) => { line(l.path, "ink", 1.5, [6, 4]); text(l.path[1], l.name); });
    cloud.forEach((p) => dot(p, "before", data.local ? 2.5 : 1));
    if (data.route) line(data.points, "after", data.local ? 1.6 : 0.8);
    const shown = stages.length ? stages[chosenStage()].arrows : null, factor = 1e-3 * scale(), chosen = Number(posture.value);
    if (!shown && !data.local) data.points.forEach((p, k) => dot(p, data.shown[chosen] === k ? "warn" : "after", data.shown[chosen] === k ? 5 : 2.5));
    if (shown) data.points.forEach((p, k) => {
      const tip = p.map((v, i) => v + factor * shown[k][i]), here = data.shown[chosen] === k;
      line([p, tip], here ? "warn" : chosenStage() ? "after" : "bad", here ? 3 : 1.6);
      const [ax, ay] = at(p), [bx, by] = at(tip), length = Math.hypot(bx - ax, by - ay);
      if (length > 5) {
        const ux = (bx - ax) / length, uy = (by - ay) / length, h = Math.min(6, length / 2);
        pen.fillStyle = pen.strokeStyle; pen.beginPath(); pen.moveTo(bx, by);
        pen.lineTo(bx - h * ux - h * 0.5 * uy, by - h * uy + h * 0.5 * ux); pen.lineTo(bx - h * ux + h * 0.5 * uy, by - h * uy - h * 0.5 * ux); pen.fill();
      }
      dot(p, here ? "warn" : "soft", here ? 4 : 1.7);
    });
    (data.arms[chosen] || []).forEach((path) => { line(path, "ink", 4); path.forEach((p) => dot(p, "ink", 4)); });
    marks.forEach((m) => { dot(m.at, "bad", 6); text(m.at, m.name); });
    (data.weights || []).forEach((w, k) => { if (w) { const p = data.arms[chosen][0][k + 1]; pen.globalAlpha = 0.6; dot(p, "bad", 4 + 18 * Math.sqrt(w)); pen.globalAlpha = 1; } });
    // what the picture's lengths are
    const left = 14, low_ = height - 16;
    pen.fillStyle = colour("soft"); pen.fillText(`axes x, y, z of ${data.base || "the base"}; grid ${step} m`, left, low_ + 4);
    if (shown) {
      const mm = nice(110 / (unit * factor)), wide = mm * unit * factor;
      pen.strokeStyle = pen.fillStyle = colour("ink"); pen.lineWidth = 2; pen.beginPath();
      pen.moveTo(left, low_ - 22); pen.lineTo(left + wide, low_ - 22);
      for (const x of [left, left + wide]) { pen.moveTo(x, low_ - 26); pen.lineTo(x, low_ - 18); }
      pen.stroke(); pen.fillText(`${mm} mm of error`, left + wide + 8, low_ - 18);
    }
    Object.assign(canvas.dataset, { yaw: view.yaw.toFixed(3), pitch: view.pitch.toFixed(3), zoom: view.zoom.toFixed(3), stage: stage ? stage.value : "", scale: scale() });
  }
  function tell() {
    if (!stages.length) { said.textContent = data.said[Number(posture.value)] || ""; draw(); return; }
    const k = data.shown[Number(posture.value)], now = stages[chosenStage()];
    const miss = (s) => `${size(s.arrows[k]).toFixed(3)} mm`, more = now === stages[0] ? "" : `, ${miss(now)} with ${now.name} added`;
    said.textContent = `Arrows are drawn ${scale()} times as long as they are. In this posture, ${data.names[k]}: ${miss(stages[0])} with the nominal model${more}.`;
    draw();
  }
  const turn = (yaw, pitch) => { view.yaw += yaw; view.pitch = Math.max(-1.57, Math.min(1.57, view.pitch + pitch)); draw(); };
  const zoom = (by) => { view.zoom = Math.max(0.3, Math.min(20, view.zoom * by)); draw(); };
  const keys = { ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1),
    "+": () => zoom(1.2), "=": () => zoom(1.2), "-": () => zoom(1 / 1.2), "0": () => { view = { ...start }; draw(); } };
  canvas.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || !keys[e.key]) return;
    keys[e.key](); e.preventDefault();
  });
  canvas.addEventListener("pointerdown", (e) => { turning.set(e.pointerId, e); canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", (e) => {
    const before = turning.get(e.pointerId);
    if (!before) return;
    const other = [...turning.values()].find((p) => p.pointerId !== e.pointerId);
    const apart = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY);
    if (other) zoom(apart(e) / Math.max(1, apart(before))); else turn(0.01 * (e.clientX - before.clientX), 0.01 * (e.clientY - before.clientY));
    turning.set(e.pointerId, e);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => turning.delete(e.pointerId));
  // a plain wheel scrolls the page
  canvas.addEventListener("wheel", (e) => { if (e.ctrlKey || document.activeElement === canvas) { zoom(e.deltaY < 0 ? 1.1 : 1 / 1.1); e.preventDefault(); } }, { passive: false });
  for (const [control, happens] of [[stage, "change"], [posture, "input"], [own, "change"]]) control?.addEventListener(happens, tell);
  longer?.addEventListener("click", () => { stretch *= 2; tell(); });
  shorter?.addEventListener("click", () => { stretch /= 2; tell(); });
  document.addEventListener("recolour", draw);
  addEventListener("resize", draw);
  tell();
})();
