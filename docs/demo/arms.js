// The arms, the metric and the mapper of one environment, from the data that docs/demo_data.py writes.
// Pure functions without a page: tests run them in Node and compare them with JAX.
"use strict";

var mimicArms = (() => {
  const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
  const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const apply = (R, v) => R.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
  const multiply = (A, B) => A.map((row) => [0, 1, 2].map((j) => row[0] * B[0][j] + row[1] * B[1][j] + row[2] * B[2][j]));

  // Rotation about a unit axis: Rodrigues' formula.
  function rotation([x, y, z], angle) {
    const c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
    return [
      [c + d * x * x, d * x * y - s * z, d * x * z + s * y],
      [d * y * x + s * z, c + d * y * y, d * y * z - s * x],
      [d * z * x - s * y, d * z * y + s * x, c + d * z * z],
    ];
  }

  // Frames after each joint, the base's first: {R, p, anchor}; the anchor is the frame's origin in the zero pose.
  function frames(arm, qpos) {
    const result = [{ R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], p: [0, 0, 0], anchor: [0, 0, 0] }];
    arm.joint_axis.forEach((axis, i) => {
      const parent = result[i], anchor = arm.joint_anchor[i];
      const p = add(parent.p, apply(parent.R, subtract(anchor, parent.anchor)));
      result.push({ R: multiply(parent.R, rotation(axis, qpos[i])), p, anchor });
    });
    return result;
  }

  const moved = (frame, point) => add(frame.p, apply(frame.R, subtract(point, frame.anchor)));

  // Positions in chain lengths and directions of the links, and the x-, y- and z-axis of the hand.
  function linkStates(arm, qpos) {
    const frame = frames(arm, qpos);
    const at = arm.link_joint.map((joint) => frame[joint + 1]);
    return {
      position: at.map((f, i) => moved(f, arm.link_position[i]).map((x) => x / arm.chain_length)),
      direction: at.map((f, i) => apply(f.R, arm.link_direction[i])),
      hand: arm.hand_axes.map((axis) => apply(frame[arm.hand_joint + 1].R, axis)),
    };
  }

  // Both ends of each segment of the centre line [m].
  function segments(arm, qpos) {
    const frame = frames(arm, qpos);
    return arm.segment_joint.map((joint, i) => [
      moved(frame[joint + 1], arm.segment_start[i]),
      moved(frame[joint + 1], arm.segment_end[i]),
    ]);
  }

  const square = (v) => v[0] * v[0] + v[1] * v[1] + v[2] * v[2];

  // Mean over all pairs of W (a_tr |p - p'| + a_rot (pi / 4) |e - e'|^2), and a_hand (pi / 8) |R - R'|^2 of the hands.
  function distance(data, expert, learner) {
    let sum = 0;
    data.correspondence.forEach((row, i) => row.forEach((w, j) => {
      if (w === 0) return;
      const translation = Math.hypot(...subtract(expert.position[i], learner.position[j]));
      const e = subtract(expert.direction[i], learner.direction[j]);
      const angle = 0.25 * Math.PI * square(e);
      sum += w * (data.weights.translation * translation + data.weights.rotation * angle);
    }));
    const links = sum / (data.correspondence.length * data.correspondence[0].length);
    const turned = expert.hand.reduce((total, axis, i) => total + square(subtract(axis, learner.hand[i])), 0);
    return links + data.weights.hand * (Math.PI / 8) * turned;
  }

  const poseDistance = (data, states, qpos) => distance(data, states, linkStates(data.learner, qpos));

  // Float32 numbers from base64, little-endian.
  function numbers(text) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Float64Array.from({ length: bytes.length / 4 }, (_, i) => view.getFloat32(4 * i, true));
  }

  // GELU, in the approximation by tanh that the network was trained with.
  const gelu = (x) => 0.5 * x * (1 + Math.tanh(Math.sqrt(2 / Math.PI) * (x + 0.044715 * x * x * x)));

  // The kernel is [inputs, outputs], row by row.
  function dense(layer, inputs) {
    const outputs = Float64Array.from(layer.bias), width = outputs.length;
    for (let i = 0; i < inputs.length; i++)
      for (let j = 0; j < width; j++) outputs[j] += inputs[i] * layer.kernel[i * width + j];
    return outputs;
  }

  // The poses that the heads of the network propose.
  function candidates(data, states) {
    let values = [...states.position.flat(), ...states.direction.flat(), ...states.hand.flat()];
    data.layers.forEach((layer, i) => {
      values = dense(layer, values);
      if (i < data.layers.length - 1) values = values.map(gelu);
    });
    const joints = data.learner.joint_range.length;
    return Array.from({ length: data.heads }, (_, head) =>
      data.learner.joint_range.map(([lower, upper], joint) => {
        const [x, y] = values.subarray(2 * (head * joints + joint));
        if (data.learner.continuous[joint]) return Math.atan2(y, x);
        return (lower + upper) / 2 + ((upper - lower) / 2) * Math.tanh(x);
      }));
  }

  function nearest(data, states, poses) {
    const distances = poses.map((pose) => poseDistance(data, states, pose));
    return poses[distances.indexOf(Math.min(...distances))];
  }

  const clip = (x, [lower, upper]) => Math.min(Math.max(x, lower), upper);

  // The expert's angles in the joints of the same name, 0 in the learner's other joints.
  const copyJoints = (data, qpos) => data.learner.joint_names.map((name, i) => {
    const joint = data.expert.joint_names.indexOf(name);
    return clip(joint < 0 ? 0 : qpos[joint], data.learner.joint_range[i]);
  });

  // Pattern search from a pose: one joint at a time by a step that halves when no joint improves.
  function improve(data, states, start, smallest) {
    let pose = start, best = poseDistance(data, states, pose);
    for (let step = 0.1; step > smallest; ) {
      let improved = false;
      for (let joint = 0; joint < pose.length; joint++)
        for (const change of [step, -step]) {
          const tried = pose.slice();
          tried[joint] += change;
          if (!data.learner.continuous[joint]) tried[joint] = clip(tried[joint], data.learner.joint_range[joint]);
          const value = poseDistance(data, states, tried);
          if (value < best - 1e-9) [pose, best, improved] = [tried, value, true];
        }
      if (!improved) step /= 2;
    }
    return pose;
  }

  // Everything that the page shows for a pose of the expert: poses and distances of mapper, copying and search.
  function compare(data, qpos, smallest = 1e-4) {
    const states = linkStates(data.expert, qpos);
    const proposed = candidates(data, states), copy = copyJoints(data, qpos);
    const searched = [...proposed, copy].map((start) => improve(data, states, start, smallest));
    const poses = { mapper: nearest(data, states, proposed), copy, search: nearest(data, states, searched) };
    const result = {};
    for (const [name, pose] of Object.entries(poses))
      result[name] = { qpos: pose, distance: poseDistance(data, states, pose) };
    return result;
  }

  function decoded(data) {
    const layers = data.layers.map(({ kernel, bias }) => ({ kernel: numbers(kernel), bias: numbers(bias) }));
    return { ...data, layers };
  }

  return { compare, decoded, linkStates, segments };
})();

if (typeof module !== "undefined") module.exports = mimicArms;
