// Draws arms as chains of capsules on a canvas, without a library: a capsule's picture is a thick line with round ends.
"use strict";

var mimicView = (() => {
  const RADIUS = 0.04; // of a link, in reaches of the larger arm
  const FLOOR = 5; // squares of the floor to each side

  // The camera looks at the origin from an azimuth and an elevation [rad]; dragging turns it.
  function makeCamera(canvas, onChange) {
    const camera = { azimuth: -1.0, elevation: 0.45, centre: [0, 0, 0], reach: 1 };
    let last = null;
    canvas.addEventListener("pointerdown", (event) => {
      last = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      camera.azimuth -= (event.clientX - last[0]) / 150;
      camera.elevation = Math.min(1.57, Math.max(0, camera.elevation + (event.clientY - last[1]) / 150));
      last = [event.clientX, event.clientY];
      onChange();
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (last = null));
    return camera;
  }

  // Pixels of a point, and its depth towards the eye. The projection is orthographic: lengths can be compared.
  function projection(canvas, camera) {
    const [ca, sa] = [Math.cos(camera.azimuth), Math.sin(camera.azimuth)];
    const [ce, se] = [Math.cos(camera.elevation), Math.sin(camera.elevation)];
    const scale = Math.min(canvas.width / 3.5, canvas.height / 2.1) / camera.reach;
    return {
      scale,
      point: (position) => {
        const [x, y, z] = position.map((value, i) => value - camera.centre[i]);
        const forward = -(ca * x + sa * y); // the eye is at azimuth and elevation
        return [
          canvas.width / 2 + scale * (ca * y - sa * x),
          canvas.height / 2 - scale * (ce * z + se * forward),
          se * z - ce * forward,
        ];
      },
    };
  }

  function line(context, a, b, width, colour) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.lineCap = "round";
    context.beginPath();
    context.moveTo(a[0], a[1]);
    context.lineTo(b[0], b[1]);
    context.stroke();
  }

  function drawFloor(context, project, { centre, reach }, ratio) {
    const side = reach / FLOOR;
    for (let i = -FLOOR; i <= FLOOR; i++)
      for (const ends of [[[i, -FLOOR], [i, FLOOR]], [[-FLOOR, i], [FLOOR, i]]]) {
        const [a, b] = ends.map(([x, y]) => project.point([centre[0] + side * x, centre[1] + side * y, 0]));
        line(context, a, b, ratio, "rgba(128, 128, 128, 0.25)");
      }
  }

  // Arms are {segments: [[start, end]], colours: [CSS], opacity, offset}. The far ones are drawn first.
  function draw(canvas, camera, arms) {
    const context = canvas.getContext("2d"), ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const project = projection(canvas, camera);
    drawFloor(context, project, camera, ratio);
    const capsules = arms.flatMap(({ segments, colours, opacity, offset }) =>
      segments.map((ends, i) => {
        const [a, b] = ends.map((point) => project.point(point.map((x, axis) => x + offset[axis])));
        const behind = opacity < 1 ? RADIUS * camera.reach : 0; // a ghost does not cover its arm
        return { a, b, colour: colours[i], opacity, depth: (a[2] + b[2]) / 2 - behind };
      }));
    const width = 2 * RADIUS * camera.reach * project.scale;
    for (const { a, b, colour, opacity } of capsules.sort((one, other) => one.depth - other.depth)) {
      context.globalAlpha = opacity;
      line(context, a, b, width + 2 * ratio, "rgba(0, 0, 0, 0.55)");
      line(context, a, b, width, colour);
      const shift = width / 6; // a highlight towards the light from the upper left
      const lit = (p) => [p[0] - shift, p[1] - shift];
      line(context, lit(a), lit(b), width / 5, "rgba(255, 255, 255, 0.35)");
    }
    context.globalAlpha = 1;
  }

  return { draw, makeCamera };
})();
