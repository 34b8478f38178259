"use strict";
// A scene in 3-D: splats as round Gaussians sorted by depth, the arm at the slider's state, what decided the verdict.

const INK = {arm: 0xa9b6c0, path: 0x0072b2, near: 0xe69f00, hit: 0xd55e00, surface: 0x78a0c8};
const LABELS = ["objects", "robot", "people"], SHELL = [0xcc79a7, 0xe69f00, 0x96789f, 0x56b4e9, 0xd55e00, 0x009e73];
const EXTENT = 3.0;  // sigmas of a splat that are drawn
const TYPES = {uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array, uint32: Uint32Array, float32: Float32Array};

async function inflated(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

let library = null;  // three.js, once
async function loadLibrary() {
  const text = document.getElementById("three").textContent;
  library ??= inflated(JSON.parse(text)).then((code) => {
    const script = document.createElement("script");
    script.textContent = new TextDecoder().decode(code);
    document.head.append(script);
  });
  return library;
}

// Reads the arrays of a scene; those of K rows lie column by column.
class Arrays {
  constructor(buffer) { this.buffer = buffer; }
  of([kind, start, count]) { return new TYPES[kind](this.buffer, start, count); }
  rows(array, columns, scale = () => 1, shift = () => 0) {
    const flat = this.of(array), count = flat.length / columns, out = new Float32Array(flat.length);
    for (let c = 0; c < columns; c++)
      for (let k = 0; k < count; k++) out[k * columns + c] = flat[c * count + k] * scale(c) + shift(c);
    return out;
  }
  points(coded) { return this.rows(coded.array, 3, (c) => coded.step[c], (c) => coded.lower[c]); }
  mesh(coded) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(this.points(coded.vertices), 3));
    const flat = this.of(coded.faces), count = flat.length / 3, faces = new Uint32Array(flat.length);
    for (let c = 0; c < 3; c++) for (let k = 0; k < count; k++) faces[3 * k + c] = flat[c * count + k];
    geometry.setIndex(new THREE.BufferAttribute(faces, 1));
    return geometry;
  }
}

// Points (K, 3) of a size in metres each; fragment: what of the square is drawn.
function sprites(points, sizes, colors, fragment) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
  geometry.setAttribute("width", new THREE.BufferAttribute(sizes, 1));
  geometry.setAttribute("shade", new THREE.BufferAttribute(colors, 4));
  const material = new THREE.ShaderMaterial({
    uniforms: {focal: {value: 1}},
    transparent: true,
    depthWrite: false,
    vertexShader: `attribute float width; attribute vec4 shade; uniform float focal; varying vec4 tint;
      void main() {
        vec4 seen = modelViewMatrix * vec4(position, 1.0);
        gl_Position = projectionMatrix * seen;
        gl_PointSize = min(width * focal / -seen.z, 512.0);
        tint = shade;
      }`,
    fragmentShader: `varying vec4 tint; void main() { vec2 off = 2.0 * gl_PointCoord - 1.0; ${fragment} }`,
  });
  const points3d = new THREE.Points(geometry, material);
  points3d.frustumCulled = false;
  return points3d;
}

const GAUSSIAN = `float a = tint.a * exp(${(-0.5 * EXTENT * EXTENT).toFixed(2)} * dot(off, off));
  if (a < 0.004) discard; gl_FragColor = vec4(tint.rgb, a);`;
const SQUARE = "gl_FragColor = tint;", DISC = "if (dot(off, off) > 1.0) discard; gl_FragColor = tint;";

class Viewer {
  constructor(host, data, buffer) {
    this.host = host;
    this.header = data.header;
    this.arrays = new Arrays(buffer);
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0xffffff);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x777777, 0.9));
    this.light = new THREE.DirectionalLight(0xffffff, 0.45);
    this.scene.add(this.light);
    this.parts = {};
    this.sorted = [];  // points that are drawn from far to near
    this.addSplats();
    this.addRest();
    this.addMotion();
    this.addDeciding();
    this.makePage();
    this.look();
    this.show(this.nearest(this.header.deciding?.time ?? 0));
  }

  part(name, object, isShown = true) {
    if (!this.parts[name]) {
      this.parts[name] = new THREE.Group();
      this.parts[name].visible = isShown;
      this.scene.add(this.parts[name]);
    }
    this.parts[name].add(object);
  }

  addSplats() {
    this.sets = this.header.splats.map((set) => {
      const centers = this.arrays.points(set.centers), labels = this.arrays.of(set.labels);
      const sigmas = this.arrays.rows(set.radii, 1, () => set.largest / 65535);
      const colors = this.arrays.rows(set.colors, 4, () => 1 / 255);
      const nodes = [];
      LABELS.forEach((name, label) => {
        const which = [...labels.keys()].filter((k) => labels[k] === label);
        if (!which.length) return;
        const pick = (flat, n) => Float32Array.from(which.flatMap((k) => [...flat.subarray(n * k, n * k + n)]));
        const widths = pick(sigmas, 1).map((sigma) => 2 * EXTENT * sigma);
        const node = sprites(pick(centers, 3), widths, pick(colors, 4), GAUSSIAN);
        this.sorted.push(node);
        this.part(name, node);
        nodes.push(node);
      });
      return {time: set.time, nodes};
    });
  }

  addRest() {
    const {unknown, surface} = this.header;
    for (const {name, points: coded, edge, shade} of unknown) {
      const points = this.arrays.points(coded), count = points.length / 3, ink = new THREE.Color(SHELL[shade]);
      const colors = Float32Array.from({length: 4 * count}, (_, k) => [ink.r, ink.g, ink.b, 0.35][k % 4]);
      const node = sprites(points, new Float32Array(count).fill(0.5 * edge), colors, SQUARE);
      this.sorted.push(Object.assign(node, {ink: `color: #${ink.getHexString()}`}));
      this.part(name, node, !this.header.motion && !this.header.splats.length && !surface);
    }
    if (surface) {
      const geometry = this.arrays.mesh(surface);
      geometry.computeVertexNormals();
      const material = new THREE.MeshLambertMaterial({color: INK.surface, side: THREE.DoubleSide});
      this.part("distance 0", new THREE.Mesh(geometry, material));
    }
    const grid = new THREE.GridHelper(4, 40, 0xaaaaaa, 0xdddddd);
    grid.rotation.x = Math.PI / 2;
    grid.material.depthWrite = false;  // splats do not write depth either: what is drawn later covers it
    grid.renderOrder = -1;
    this.part("grid of 10 cm", grid);
  }

  addMotion() {
    const motion = this.header.motion;
    if (!motion) return;
    this.seconds = this.arrays.of(motion.seconds);
    const states = this.seconds.length, links = motion.links.length;
    this.quats = this.arrays.rows(motion.quats, 4 * links, () => 1 / 32767);
    this.places = this.arrays.points(motion.places);
    this.links = motion.links.map((mesh) => {
      const geometry = this.arrays.mesh(mesh).toNonIndexed();  // so that each face has its own normal
      geometry.computeVertexNormals();
      const link = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({color: INK.arm}));
      this.part("arm", link);
      return link;
    });
    const path = this.arrays.points(motion.path), colors = new Float32Array(4 * states), ink = new THREE.Color();
    motion.clearance.forEach((metres, k) => {
      ink.set(metres === null || metres >= motion.margin ? INK.path : metres > 0 ? INK.near : INK.hit);
      colors.set([ink.r, ink.g, ink.b, 1], 4 * k);
    });
    const dots = sprites(path, new Float32Array(states).fill(0.009), colors, DISC);
    this.sorted.push(dots);
    this.part("path", dots);
    this.numStates = states;
  }

  addDeciding() {
    const deciding = this.header.deciding;
    if (!deciding) return;
    const ball = (place, radius, color, opacity) => {
      const material = new THREE.MeshBasicMaterial({color, transparent: true, opacity, depthTest: false});
      const mesh = new THREE.Mesh(new THREE.SphereGeometry(radius, 24, 16), material);
      mesh.position.set(...place);
      mesh.renderOrder = 2;
      this.part("what decided", mesh);
    };
    if (deciding.center) ball(deciding.center, deciding.radius, INK.near, 0.5);
    ball(deciding.place, 0.01, INK.hit, 1);
    if (!deciding.center) return;
    const ends = [deciding.place, deciding.center].map((p) => new THREE.Vector3(...p));
    const material = new THREE.LineBasicMaterial({color: INK.hit, transparent: true, depthTest: false});
    const line = new THREE.Line(new THREE.BufferGeometry().setFromPoints(ends), material);
    line.renderOrder = 2;
    this.part("what decided", line);
  }

  makePage() {
    const add = (kind, parent, values = {}) => {
      const node = Object.assign(document.createElement(kind), values);
      parent.append(node);
      return node;
    };
    this.renderer = new THREE.WebGLRenderer({antialias: true});
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.canvas = this.renderer.domElement;
    this.host.append(this.canvas);
    const bar = add("div", this.host, {className: "bar"});
    if (this.numStates) {
      this.play = add("button", bar, {type: "button", textContent: "play", onclick: () => this.togglePlay()});
      const range = {type: "range", min: 0, max: this.numStates - 1, step: 1, ariaLabel: "time"};
      this.slider = add("input", bar, {...range, oninput: () => this.show(+this.slider.value)});
      this.words = add("output", bar);
    }
    const cameras = this.header.cameras, menu = add("select", bar, {ariaLabel: "camera"});
    menu.onchange = () => this.lookFrom(cameras[menu.value]);
    add("option", menu, {textContent: "view from", disabled: true, selected: true});
    cameras.forEach(({name}, k) => add("option", menu, {value: k, textContent: name}));
    const ticks = add("div", this.host, {className: "ticks"});
    for (const [name, group] of Object.entries(this.parts)) {
      const label = add("label", ticks, {style: group.children[0].ink ?? ""});
      const change = (event) => { group.visible = event.target.checked; this.draw(); };
      add("input", label, {type: "checkbox", checked: group.visible, onchange: change});
      label.append(" " + name);
    }
    if (this.header.deciding) add("p", this.host, {className: "decided", textContent: this.header.deciding.sentence});
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(this.host);
  }

  look() {
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.01, 100);
    this.camera.up.set(0, 0, 1);
    this.target = new THREE.Vector3(...(this.header.deciding?.place ?? this.header.middle));
    [this.turn, this.tilt] = [-0.8, 0.55];
    this.far = (this.header.deciding ? 0.5 : 1.1) * this.header.size;
    this.canvas.onpointerdown = (event) => this.canvas.setPointerCapture(event.pointerId);
    this.canvas.onpointermove = ({movementX: x, movementY: y, shiftKey, buttons}) => {
      if (!buttons) return;
      if (shiftKey || buttons & 6) this.pan(x, y);
      else {
        this.turn -= 0.007 * x;
        this.tilt = Math.min(Math.max(this.tilt + 0.007 * y, -1.5), 1.5);
      }
      this.draw();
    };
    this.canvas.oncontextmenu = (event) => event.preventDefault();
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.far = Math.min(Math.max(this.far * Math.exp(0.001 * event.deltaY), 0.05), 50);
      this.draw();
    }, {passive: false});
    this.header.cameras.slice(0, this.header.deciding ? 0 : 1).forEach((first) => this.lookFrom(first));
    this.resize();
  }

  lookFrom({eye, ahead: [x, y, z], fov}) {  // upright, whatever the recorded camera's roll
    [this.turn, this.tilt, this.far, this.camera.fov] = [Math.atan2(-y, -x), Math.asin(-z), this.header.size, fov];
    this.target.set(x, y, z).multiplyScalar(this.far).add(new THREE.Vector3(...eye));
    this.resize();
  }

  pan(x, y) {
    const scale = this.far / this.canvas.clientHeight, right = new THREE.Vector3(), up = new THREE.Vector3();
    this.camera.matrix.extractBasis(right, up, new THREE.Vector3());
    this.target.addScaledVector(right, -x * scale).addScaledVector(up, y * scale);
  }

  resize() {
    const width = this.host.clientWidth, height = Math.round(Math.min(0.62 * width, 0.75 * window.innerHeight));
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  nearest(time) {
    const off = (this.seconds ?? []).map((second) => Math.abs(second - time));
    return Math.max(off.indexOf(Math.min(...off)), 0);
  }

  show(state) {
    if (this.links) {
      const count = this.links.length;
      this.links.forEach((link, k) => {
        link.quaternion.fromArray(this.quats, 4 * (state * count + k)).normalize();
        link.position.fromArray(this.places, 3 * (state * count + k));
      });
      const metres = this.header.motion.clearance[state], distance = metres === null ? "-" : (1000 * metres).toFixed(1);
      this.words.textContent = `${this.seconds[state].toFixed(2)} s, ${distance} mm`;
      this.slider.value = state;
    }
    const known = Math.max(0, this.sets.filter((set) => set.time <= (this.seconds?.[state] ?? 0)).length - 1);
    this.sets.forEach((set, k) => set.nodes.forEach((node) => { node.visible = k === known; }));
    this.draw();
  }

  togglePlay() {
    if (this.timer) { clearInterval(this.timer); this.timer = null; this.play.textContent = "play"; return; }
    const started = performance.now(), first = this.seconds[this.slider.value], end = this.seconds[this.numStates - 1];
    const from = first >= end ? 0 : first;
    this.play.textContent = "pause";
    this.timer = setInterval(() => {
      const time = from + (performance.now() - started) / 1000;
      this.show(this.nearest(time));
      if (time >= end) this.togglePlay();
    }, 40);
  }

  draw() {
    if (this.asked || this.isClosed) return;
    this.asked = requestAnimationFrame(() => { this.asked = null; this.paint(); });
  }

  paint() {
    const level = Math.cos(this.tilt);
    const offset = [level * Math.cos(this.turn), level * Math.sin(this.turn), Math.sin(this.tilt)];
    this.camera.position.set(...offset).multiplyScalar(this.far).add(this.target);
    this.camera.lookAt(this.target);
    this.camera.updateMatrixWorld();
    this.light.position.copy(this.camera.position);
    const pixels = this.renderer.getDrawingBufferSize(new THREE.Vector2()).y;
    const focal = pixels / (2 * Math.tan((this.camera.fov * Math.PI) / 360));
    for (const node of this.sorted) if (node.visible && node.parent.visible) this.sort(node, focal);
    this.renderer.render(this.scene, this.camera);
    this.host.dataset.painted = (+this.host.dataset.painted || 0) + 1;
  }

  sort(node, focal) {
    node.material.uniforms.focal.value = focal;
    const at = node.geometry.attributes.position.array, m = this.camera.matrixWorldInverse.elements, count = at.length / 3;
    const depth = new Float32Array(count), order = new Uint32Array(count);
    for (let k = 0; k < count; k++) {
      depth[k] = m[2] * at[3 * k] + m[6] * at[3 * k + 1] + m[10] * at[3 * k + 2];
      order[k] = k;
    }
    order.sort((a, b) => depth[a] - depth[b]);
    node.geometry.setIndex(new THREE.BufferAttribute(order, 1));
  }

  close() {
    if (this.timer) this.togglePlay();
    this.watch.disconnect();
    if (this.asked) cancelAnimationFrame(this.asked);
    this.isClosed = true;  // what is still to be painted, is not: a lost context has no shaders
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.host.replaceChildren();
  }
}

let opened = null;  // one at a time: browsers keep few contexts
async function openScene(host) {
  opened?.close();
  opened = null;
  host.textContent = "loading ...";
  try {
    await loadLibrary();
    const data = JSON.parse(document.getElementById(host.dataset.scene).textContent);
    const buffer = await inflated(data.bytes);
    host.replaceChildren();
    host.viewer = opened = new Viewer(host, data, buffer);
  } catch (error) {
    host.textContent = `This browser cannot show it in 3-D: ${error.message}`;
  }
}
