// The demo page: sliders for the expert's joints, the learner's pose from the mapper, both arms, and the distances.
"use strict";

var mimicDemo = (() => {
  const ROWS = { mapper: "mapper (network)", search: "best pose found by a search", copy: "copying the joints" };
  const FOLDER = document.currentScript.src.replace(/[^/]*$/, "");
  const loaded = {};
  let data = null, qpos = [], shown = "mapper", camera = null, element = null, pending = 0;

  // Called by the script of each environment.
  function add(decodable) {
    loaded[decodable.name] = mimicArms.decoded(decodable);
  }

  function make(tag, attributes = {}, ...children) {
    const result = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) result.setAttribute(name, value);
    result.append(...children);
    return result;
  }

  // The layout: a picture, and next to it the choice of arms, sliders and distances.
  function start(root, names) {
    const canvas = make("canvas", { "aria-label": "expert and learner; drag to turn the view" });
    const choice = make("select", { "aria-label": "arms" }, ...names.map((name) => make("option", {}, name)));
    const sliders = make("div", { class: "mimic-sliders" });
    const distances = make("table", { class: "mimic-distances" });
    const random = make("button", { type: "button", class: "md-button" }, "random pose");
    const zero = make("button", { type: "button", class: "md-button" }, "zero pose");
    const note = make("p", { class: "mimic-note" });
    root.append(canvas, make("div", { class: "mimic-panel" }, choice, sliders, zero, random, distances, note));
    element = { canvas, choice, sliders, distances, note };
    camera = mimicView.makeCamera(canvas, drawArms);
    choice.addEventListener("change", () => choose(choice.value));
    random.addEventListener("click", () => setPose(data.expert.joint_range.map(([a, b]) => a + (b - a) * Math.random())));
    zero.addEventListener("click", () => setPose(data.expert.joint_range.map(() => 0)));
    window.addEventListener("resize", drawArms);
    const [name, angles] = fromAddress();
    choose(names.includes(name) ? name : names[0], angles);
  }

  // The part of the address after #, as in #panda4dof=0.6,0.7,-0.5: name and angles.
  function fromAddress() {
    const [name, angles] = decodeURIComponent(location.hash.slice(1)).split("=");
    const values = angles ? angles.split(",").map(Number) : [];
    return [name, values.every(Number.isFinite) ? values : []];
  }

  function choose(name, angles = []) {
    element.choice.value = name;
    if (loaded[name]) return showArms(name, angles);
    element.note.textContent = `loading ${name} ...`;
    const script = make("script", { src: `${FOLDER}${name}.js` });
    script.addEventListener("load", () => showArms(name, angles));
    script.addEventListener("error", () => (element.note.textContent = `${name}.js cannot be loaded`));
    document.head.append(script);
  }

  function showArms(name, angles) {
    if (element.choice.value !== name) return; // another one was chosen since
    data = loaded[name];
    const ranges = data.expert.joint_range;
    const planar = data.expert.joint_axis.every(([x, y]) => x === 0 && y === 0);
    camera.reach = 1.05 * data.expert.chain_length;
    camera.centre = planar ? [0, 0, 0] : [0, 0, 0.3 * data.expert.chain_length];
    camera.elevation = planar ? 1.57 : 0.35;
    camera.azimuth = planar ? -Math.PI / 2 : -1.0;
    element.sliders.replaceChildren(...ranges.map(makeSlider));
    element.note.textContent =
      `Mean distance on held-out poses: ${digits(data.held_out.mapper)} mapper, ${digits(data.held_out.search)} optimum, ` +
      `${digits(data.held_out.copy)} copying.`;
    const rest = [0.5, 0.6, -0.4, -1.2, 0.4, 1.0, 0.3];
    const clip = (x, [lower, upper]) => Math.min(Math.max(x, lower), upper);
    setPose(ranges.map((range, i) => clip(angles.length === ranges.length ? angles[i] : rest[i % rest.length], range)));
  }

  function makeSlider([lower, upper], joint) {
    const name = data.expert.joint_names[joint];
    const input = make("input", { type: "range", min: lower, max: upper, step: "any", "aria-label": name });
    input.addEventListener("input", () => setPose(qpos.map((x, i) => (i === joint ? Number(input.value) : x))));
    return make("label", {}, make("span", {}, name), input, make("output"));
  }

  function setPose(pose) {
    qpos = pose;
    [...element.sliders.children].forEach((row, i) => {
      row.children[1].value = qpos[i];
      row.children[2].textContent = `${qpos[i].toFixed(2)} rad`;
    });
    clearTimeout(pending); // several events of a slider are one update
    pending = setTimeout(update);
  }

  function update() {
    data.result = mimicArms.compare(data, qpos);
    element.distances.replaceChildren(
      make("tr", {}, make("th", {}, "learner moved by"), make("th", {}, "distance")),
      ...Object.entries(ROWS).map(([name, text]) => {
        const row = make("tr", { "data-name": name }, make("td", {}, text), make("td", {}, digits(data.result[name].distance)));
        if (name === shown) row.classList.add("mimic-shown");
        row.addEventListener("click", () => { shown = name; update(); });
        return row;
      }));
    drawArms();
    history.replaceState(null, "", `#${data.name}=${qpos.map((x) => x.toFixed(4)).join(",")}`);
  }

  const digits = (distance) => distance.toFixed(4);

  // Links at the same fraction of the arm's length correspond, and have the same colour.
  function colours(segments) {
    const lengths = segments.map(([a, b]) => Math.hypot(...a.map((x, i) => x - b[i])));
    const total = lengths.reduce((sum, length) => sum + length, 0);
    let before = 0;
    return lengths.map((length) => {
      const middle = (before + length / 2) / total;
      before += length;
      return `hsl(${Math.round(20 + 260 * middle)}, 70%, 52%)`;
    });
  }

  // Expert to the left, learner to the right, and the expert as a ghost behind the learner.
  function drawArms() {
    if (!data || !data.result) return;
    const apart = 0.72 * camera.reach;
    const right = [-Math.sin(camera.azimuth) * apart, Math.cos(camera.azimuth) * apart, 0];
    const left = right.map((x) => -x);
    const expert = mimicArms.segments(data.expert, qpos);
    const learner = mimicArms.segments(data.learner, data.result[shown].qpos);
    const scale = data.expert.chain_length / data.learner.chain_length; // the metric compares shapes
    const scaled = learner.map((ends) => ends.map((point) => point.map((x) => scale * x)));
    mimicView.draw(element.canvas, camera, [
      { segments: expert, colours: colours(expert), opacity: 1, offset: left },
      { segments: expert, colours: expert.map(() => "#999"), opacity: 0.3, offset: right },
      { segments: scaled, colours: colours(scaled), opacity: 1, offset: right },
    ]);
  }

  return { add, start, result: () => data && data.result, pose: () => qpos };
})();
