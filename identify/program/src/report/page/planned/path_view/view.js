// Animates the arm along a path or from pose to pose; mouse or finger turn the view. The bodies are those of the check for collisions.
(() => {
  const { Renderer, Camera, Transform, Program, Mesh, Geometry, Cylinder, Sphere, Box, Orbit, Vec3 } = OGL;
  const scene = JSON.parse(document.getElementById("path-scene").textContent);
  const canvas = document.getElementById("path-canvas");
  const [play, when, shown] = ["path-play", "path-time", "path-shown"].map((id) => document.getElementById(id));

  let renderer;
  try {
    renderer = new Renderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
  } catch {
    document.getElementById("path-view").classList.add("without");
    return;
  }
  const gl = renderer.gl;
  gl.clearColor(0.965, 0.973, 0.98, 1);

  const vertex = `
    attribute vec3 position;
    attribute vec3 normal;
    uniform mat4 modelViewMatrix;
    uniform mat4 projectionMatrix;
    uniform mat3 normalMatrix;
    varying vec3 across;
    void main() {
      across = normalize(normalMatrix * normal);
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    }`;
  const shaded = `
    precision highp float;
    uniform vec4 colour;
    varying vec3 across;
    void main() {
      float light = 0.62 + 0.38 * max(dot(normalize(across), normalize(vec3(0.3, 0.6, 0.7))), 0.0);
      gl_FragColor = vec4(colour.rgb * light, colour.a);
    }`;
  const plain = `
    precision highp float;
    uniform vec4 colour;
    void main() { gl_FragColor = colour; }`;
  const lineVertex = `
    attribute vec3 position;
    uniform mat4 modelViewMatrix;
    uniform mat4 projectionMatrix;
    void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`;
  const colours = {
    link: [0.93, 0.55, 0.2, 1], plate: [0.3, 0.35, 0.42, 1], rod: [0.12, 0.44, 0.7, 1], box: [0.6, 0.63, 0.68, 0.55],
    grid: [0.8, 0.83, 0.87, 1], path: [0.35, 0.55, 0.75, 1], x: [0.8, 0.2, 0.2, 1], y: [0.2, 0.6, 0.3, 1],
  };
  const program = (colour, line) =>
    new Program(gl, {
      vertex: line ? lineVertex : vertex,
      fragment: line ? plain : shaded,
      uniforms: { colour: { value: colours[colour] } },
      transparent: colours[colour][3] < 1,
    });
  const programs = Object.fromEntries(Object.keys(colours).map((name) => [name, program(name, ["grid", "path"].includes(name))]));

  // The robot's z axis points up; in OGL it is the y axis.
  const world = new Transform();
  world.rotation.x = -Math.PI / 2;
  const [cylinder, sphere] = [new Cylinder(gl, { radialSegments: 24, openEnded: true }), new Sphere(gl, { widthSegments: 24 })];
  const add = (geometry, colour, mode) => {
    const mesh = new Mesh(gl, { geometry, program: programs[colour], mode: mode ?? gl.TRIANGLES });
    mesh.setParent(world);
    return mesh;
  };
  const up = new Vec3(0, 1, 0);
  // A capsule between two moving points.
  const capsule = (colour, radius) => {
    const side = add(cylinder, colour);
    const ends = [add(sphere, colour), add(sphere, colour)];
    return (a, b) => {
      const along = new Vec3().sub(b, a);
      const length = along.len();
      side.visible = length > 1e-6;
      side.scale.set(2 * radius, Math.max(length, 1e-6), 2 * radius);
      side.position.copy(a).add(b).multiply(0.5);
      if (side.visible) {
        const direction = along.multiply(1 / length);
        const axis = new Vec3().cross(up, direction);
        const sine = axis.len();
        const angle = Math.atan2(sine, up.dot(direction));
        side.quaternion.fromAxisAngle(sine > 1e-9 ? axis.multiply(1 / sine) : new Vec3(1, 0, 0), angle);
      }
      ends.forEach((end, i) => {
        end.position.copy(i ? b : a);
        end.scale.set(2 * radius);
      });
    };
  };
  const lines = (points, colour, mode) => add(new Geometry(gl, { position: { size: 3, data: new Float32Array(points) } }), colour, mode);

  for (const [one, other] of scene.boxes_m) {
    const box = add(new Box(gl), "box");
    box.position.set(...one.map((x, i) => (x + other[i]) / 2));
    box.scale.set(...one.map((x, i) => Math.abs(x - other[i])));
  }
  const reach = scene.reach_m;
  const grid = [];
  const half = Math.ceil(1.2 * reach * 2) / 2;
  for (let at = -half; at <= half + 1e-9; at += 0.5) {
    grid.push(at, -half, scene.floor_m, at, half, scene.floor_m, -half, at, scene.floor_m, half, at, scene.floor_m);
  }
  lines(grid, "grid", gl.LINES);
  ["x", "y"].forEach((axis, i) => {
    const tip = new Vec3();
    tip[i] = 0.25 * reach;
    capsule(axis, 0.006 * reach)(new Vec3(), tip);
  });
  const { frames, capsules, ends, frames_per_pose } = scene;
  lines(frames.flatMap((frame) => frame.slice(3 * ends, 3 * ends + 3)), "path", gl.LINE_STRIP);
  frames.forEach((frame, i) => {
    if (!frames_per_pose || i % frames_per_pose) return;
    const stop = add(sphere, "rod");
    stop.position.set(...frame.slice(3 * ends, 3 * ends + 3));
    stop.scale.set(0.016 * reach);
  });
  const bodies = capsules.map(([from, to, colour, radius]) => ({ from, to, place: capsule(colour, radius) }));

  const camera = new Camera(gl, { near: 0.01 * reach, far: 20 * reach, fov: 35 });
  camera.position.set(1.2 * reach, 1.1 * reach, 1.8 * reach);
  const target = new Vec3(0.35 * reach, 0.4 * reach, 0);
  const orbit = new Orbit(camera, { element: canvas, target, enableZoom: false, rotateSpeed: 0.15 });
  document.getElementById("path-nearer").onclick = () => zoom(0.8);
  document.getElementById("path-farther").onclick = () => zoom(1.25);
  const zoom = (by) => camera.perspective({ fov: Math.min(Math.max(camera.fov * by, 4), 80) });

  const vector = (frame, i) => new Vec3(frame[3 * i], frame[3 * i + 1], frame[3 * i + 2]);
  const between = (a, b, part) => a.map((x, i) => x + part * (b[i] - x));
  // Zero if there is a single pose, which has one frame.
  const end_s = scene.times_s[scene.times_s.length - 1];
  let now_s = 0;
  let before_ms;
  let playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  play.onclick = () => (playing = !playing);
  when.oninput = () => {
    playing = false;
    now_s = (end_s * when.value) / when.max;
  };
  const draw = (ms) => {
    if (playing && end_s) now_s = (now_s + (ms - (before_ms ?? ms)) * 1e-3) % end_s;
    before_ms = ms;
    const part = end_s && now_s / end_s;
    const at = part * (frames.length - 1);
    const first = Math.max(Math.min(Math.floor(at), frames.length - 2), 0);
    const frame = between(frames[first], frames[first + 1] ?? frames[first], at - first);
    bodies.forEach(({ from, to, place }) => place(vector(frame, from), vector(frame, to)));
    play.textContent = playing ? "Pause" : "Play";
    when.value = when.max * part;
    shown.textContent = frames_per_pose
      ? `pose ${1 + Math.floor(now_s + 0.5)} of ${1 + (frames.length - 1) / frames_per_pose}`
      : `${now_s.toFixed(1)} of ${end_s.toFixed(0)} s`;
    const [width, height] = [canvas.parentElement.clientWidth, Math.min(canvas.parentElement.clientWidth, 480)];
    if (renderer.width !== width || renderer.height !== height) {
      renderer.dpr = Math.min(window.devicePixelRatio, 2);
      renderer.setSize(width, height);
      camera.perspective({ aspect: width / height });
    }
    orbit.update();
    renderer.render({ scene: world, camera });
    requestAnimationFrame(draw);
  };
  requestAnimationFrame(draw);
})();
