// The shapes of the report, turned with the mouse: WebGL without any library. The data stand beside it in the page.
(() => {
  "use strict";
  const shapes = JSON.parse(document.getElementById("shapes").textContent);
  const canvas = document.getElementById("turn"), gl = canvas.getContext("webgl", { antialias: true });
  if (!gl) {
    canvas.replaceWith("This browser shows no WebGL: the pictures are all there is.");
    return;
  }
  const which = document.getElementById("which"), paint = document.getElementById("paint");
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const meshes = shapes.map((s) => {
    const place = new Int16Array(bytes(s.vertices).buffer), faces = new Uint16Array(bytes(s.faces).buffer);
    return { place, faces, normal: normals(place, faces), colors: Object.fromEntries(Object.entries(s.colors).map(([k, v]) => [k, bytes(v)])) };
  });

  function normals(place, faces) { // the sum of the faces around each vertex, weighted by their area
    const sum = new Float32Array(place.length);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const u = [0, 1, 2].map((k) => place[b + k] - place[a + k]), v = [0, 1, 2].map((k) => place[c + k] - place[a + k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      for (const at of [a, b, c]) for (let k = 0; k < 3; k++) sum[at + k] += n[k];
    }
    return sum;
  }

  function shader(kind, text) {
    const made = gl.createShader(kind);
    gl.shaderSource(made, text);
    gl.compileShader(made);
    gl.attachShader(program, made);
  }
  const program = gl.createProgram();
  shader(gl.VERTEX_SHADER, `attribute vec3 place, normal, color; uniform mat3 turn; uniform float size, wide;
    varying vec3 rgb, n;
    void main() {
      vec3 p = turn * (place / 32767.0) * size; n = turn * normal; rgb = color;
      gl_Position = vec4(vec2(p.x / wide, p.y) * min(1.0, wide), -0.15 * p.z, 1.0);
    }`);
  shader(gl.FRAGMENT_SHADER, `precision mediump float; varying vec3 rgb, n;
    void main() { gl_FragColor = vec4(rgb * (0.4 + 0.6 * abs(dot(normalize(n), normalize(vec3(-0.35, 0.5, 0.79))))), 1.0); }`);
  gl.linkProgram(program);
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(1, 1, 1, 1);
  const uniform = (name) => gl.getUniformLocation(program, name);

  function fill(name, data, type, scaled) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    const at = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, 3, type, scaled, 0, 0);
  }
  let count = 0;
  function load() {
    const mesh = meshes[which.value], colors = mesh.colors[paint.value] || mesh.colors.seen;
    fill("place", Float32Array.from(mesh.place), gl.FLOAT, false);
    fill("normal", mesh.normal, gl.FLOAT, false);
    fill("color", colors, gl.UNSIGNED_BYTE, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.faces, gl.STATIC_DRAW);
    count = mesh.faces.length;
    draw();
  }

  let turn = [1, 0, 0, 0, 1, 0, 0, 0, 1], size = 1, held = null, alone = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  function turned(x, y) { // first about the screen's vertical by x, then about its horizontal by y
    const [c, s, d, t] = [Math.cos(x), Math.sin(x), Math.cos(y), Math.sin(y)];
    const by = [c, t * s, -d * s, 0, d, t, s, -t * c, d * c], out = []; // column by column, as WebGL has it
    for (let j = 0; j < 3; j++) for (let i = 0; i < 3; i++) out.push(by[i] * turn[3 * j] + by[i + 3] * turn[3 * j + 1] + by[i + 6] * turn[3 * j + 2]);
    turn = out;
  }
  function draw() {
    const sharp = devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * sharp;
    canvas.height = canvas.clientHeight * sharp;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(uniform("turn"), false, turn);
    gl.uniform1f(uniform("size"), size);
    gl.uniform1f(uniform("wide"), canvas.width / canvas.height);
    gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_SHORT, 0);
  }
  canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; alone = false; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (e) => {
    if (!held) return;
    turned((e.clientX - held[0]) / 120, (e.clientY - held[1]) / 120);
    held = [e.clientX, e.clientY];
    draw();
  });
  canvas.addEventListener("wheel", (e) => {
    if (alone) return; // the page scrolls until the shape was taken hold of
    e.preventDefault();
    size = Math.min(6, Math.max(0.3, size * Math.exp(-e.deltaY / 600)));
    draw();
  }, { passive: false });
  which.addEventListener("change", load);
  paint.addEventListener("change", load);
  addEventListener("resize", draw);
  turned(0.45, 0.35);
  load();
  (function step() {
    if (!alone) return;
    turned(0.008, 0);
    draw();
    requestAnimationFrame(step);
  })();
})();
