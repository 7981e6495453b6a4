//<![CDATA[
// Shows the points of the map with WebGL 2: turned, moved and zoomed by mouse or touch, shaded from their depth.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("points").textContent);
  const canvas = document.getElementById("canvas");
  const gl = canvas.getContext("webgl2", { antialias: false });
  if (!gl) {
    document.getElementById("hint").textContent = "This browser has no WebGL 2, so that the map cannot be shown in 3D.";
    return;
  }
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

  const pointShader = [`#version 300 es
    in vec3 place; in vec3 rgb; in float label;
    uniform vec3 low, extent; uniform mat4 view; uniform float pixels, cut; uniform bool byClass;
    uniform sampler2D classes;
    out vec3 color;
    void main() {
      vec3 at = low + extent * place;
      vec4 shown = texelFetch(classes, ivec2(int(label), 0), 0);
      color = byClass ? shown.rgb * (0.75 + 0.4 * dot(rgb, vec3(0.333))) : rgb;
      gl_Position = shown.a > 0.5 && at.z <= cut ? view * vec4(at, 1.0) : vec4(0.0, 0.0, 2.0, 1.0);
      gl_PointSize = clamp(pixels / gl_Position.w, 1.5, 48.0);
    }`, `#version 300 es
    precision highp float;
    in vec3 color; out vec4 pixel;
    void main() {
      vec2 from = 2.0 * gl_PointCoord - 1.0;
      if (dot(from, from) > 1.3) discard;
      pixel = vec4(color, 1.0);
    }`];
  // Eye-dome lighting: a pixel is darker the more its surroundings stand in front of it.
  const shadeShader = [`#version 300 es
    in vec2 corner;
    void main() { gl_Position = vec4(corner, 0.0, 1.0); }`, `#version 300 es
    precision highp float;
    uniform sampler2D colors, depths; uniform float near, far, radius;
    out vec4 pixel;
    float metres(ivec2 at) {
      float z = texelFetch(depths, clamp(at, ivec2(0), textureSize(depths, 0) - 1), 0).r;
      return z == 1.0 ? far : near * far / (far - z * (far - near));
    }
    void main() {
      ivec2 at = ivec2(gl_FragCoord.xy);
      float here = log2(metres(at)), hidden = 0.0;
      for (int i = 0; i < 8; i++) {
        float a = 0.785398 * float(i);
        hidden += clamp(here - log2(metres(at + ivec2(round(radius * vec2(cos(a), sin(a)))))), 0.0, 0.06);
      }
      pixel = vec4(texelFetch(colors, at, 0).rgb * (here >= log2(far) - 1e-4 ? 1.0 : exp(-2.2 * hidden)), 1.0);
    }`];
  function program([vertex, fragment]) {
    const made = gl.createProgram();
    [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(([kind, source]) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    });
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }
  const points = program(pointShader), shade = program(shadeShader);
  const uniform = (made, name) => gl.getUniformLocation(made, name);
  function attribute(made, name, values, size, kind, normalized) {
    const place = gl.getAttribLocation(made, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, kind, normalized, 0, 0);
  }
  function texture() {
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return made;
  }
  const cloud = gl.createVertexArray(), corners = gl.createVertexArray();
  gl.bindVertexArray(cloud);
  const places = new Uint16Array(bytes(data.xyz).buffer);
  attribute(points, "place", places, 3, gl.UNSIGNED_SHORT, true);
  attribute(points, "rgb", bytes(data.rgb), 3, gl.UNSIGNED_BYTE, true);
  attribute(points, "label", bytes(data.label), 1, gl.UNSIGNED_BYTE, false);
  gl.bindVertexArray(corners);
  attribute(shade, "corner", new Float32Array([-1, -1, 3, -1, -1, 3]), 2, gl.FLOAT, false);
  const classes = texture(), colors = texture(), depths = texture(), target = gl.createFramebuffer();
  const table = new Uint8Array(bytes(data.classes));  // 256 x (red, green, blue, shown)

  // The camera: turned about `centre`, with z up; metres and radians.
  const high = data.low.map((v, i) => v + data.extent[i]);
  const reach = Math.hypot(...data.extent), FIELD_OF_VIEW = 0.8, focal = 1 / Math.tan(FIELD_OF_VIEW / 2);
  let centre, azimuth, elevation, distance;
  const axes = () => {
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    return [[-sa, ca, 0], [-ca * se, -sa * se, ce], [ca * ce, sa * ce, se]];  // right, up, towards the viewer
  };
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  // Of the width and of the height of the picture, the smaller one has the field of view.
  const focals = () => { const w = canvas.clientWidth || 1, h = canvas.clientHeight || 1, side = Math.min(w, h); return [focal * side / w, focal * side / h]; };
  function goBack() {  // the nearest place from which all that is not cut away is seen, but for a few stray points
    [azimuth, elevation] = [data.azimuth, 0.85];
    const seen = [], way = axes(), [fx, fy] = focals().map((f) => 1.08 * f), cut = data.ceiling ?? Infinity;
    for (let k = 0; k < data.count; k += Math.ceil(data.count / 20000)) {
      const at = data.low.map((v, i) => v + data.extent[i] * places[3 * k + i] / 65535);
      if (at[2] <= cut) seen.push(way.map((axis) => dot(axis, at)));
    }
    const ranked = (value, part) => seen.map(value).sort((p, q) => p - q)[Math.floor(part * (seen.length - 1))];
    // The edges of the picture are planes through the eye: the point that is farthest out puts each in its place.
    const [a, b, c, d] = [[fx, 0], [-fx, 0], [0, fy], [0, -fy]].map(([p, q]) => ranked(([x, y, z]) => p * x + q * y + z, 0.999));
    const middle = [(a - b) / (2 * fx), (c - d) / (2 * fy), ranked((at) => at[2], 0.5)];
    distance = Math.max((a + b) / 2 - middle[2], (c + d) / 2 - middle[2], 0.1);
    centre = [0, 1, 2].map((i) => way[0][i] * middle[0] + way[1][i] * middle[1] + way[2][i] * middle[2]);
  }

  function draw() {
    waiting = false;
    const density = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * density), height = Math.round(canvas.clientHeight * density);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height || !draw.ready) {
      [canvas.width, canvas.height, draw.ready] = [width, height, true];
      gl.bindTexture(gl.TEXTURE_2D, colors);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
      gl.bindTexture(gl.TEXTURE_2D, depths);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
      gl.bindFramebuffer(gl.FRAMEBUFFER, target);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, colors, 0);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
    }
    const near = Math.max(0.02, distance - reach), far = distance + 2 * reach;
    const [right, up, back] = axes();
    const eye = centre.map((v, i) => v + distance * back[i]);
    const [fx, fy] = focals(), a = (far + near) / (near - far), b = 2 * far * near / (near - far);
    const view = [0, 1, 2].flatMap((i) => [fx * right[i], fy * up[i], a * back[i], -back[i]]);
    view.push(-fx * dot(right, eye), -fy * dot(up, eye), -a * dot(back, eye) + b, dot(back, eye));

    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.clearColor(31 / 255, 35 / 255, 43 / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(points);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, classes);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, table);
    gl.uniform1i(uniform(points, "classes"), 0);
    gl.uniform3fv(uniform(points, "low"), data.low);
    gl.uniform3fv(uniform(points, "extent"), data.extent);
    gl.uniformMatrix4fv(uniform(points, "view"), false, view);
    gl.uniform1f(uniform(points, "pixels"), 0.5 * height * fy * 1.4 * data.spacing);
    gl.uniform1f(uniform(points, "cut"), cutHeight());
    gl.uniform1i(uniform(points, "byClass"), document.querySelector("[name=look]:checked").value === "class" ? 1 : 0);
    gl.bindVertexArray(cloud);
    gl.drawArrays(gl.POINTS, 0, data.count);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(shade);
    gl.bindTexture(gl.TEXTURE_2D, colors);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, depths);
    gl.uniform1i(uniform(shade, "colors"), 0);
    gl.uniform1i(uniform(shade, "depths"), 1);
    gl.uniform1f(uniform(shade, "near"), near);
    gl.uniform1f(uniform(shade, "far"), far);
    gl.uniform1f(uniform(shade, "radius"), 1.6 * density);
    gl.bindVertexArray(corners);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.activeTexture(gl.TEXTURE0);
    canvas.dataset.drawn = Number(canvas.dataset.drawn || 0) + 1;
  }
  let waiting = false;
  function redraw() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }

  const slider = document.getElementById("cut");
  const cutHeight = () => (slider.value === slider.max ? high[2] + 1 : data.low[2] + data.extent[2] * slider.value / slider.max);
  function slide() {
    const uncut = slider.value === slider.max;
    document.getElementById("height").textContent = uncut ? "nothing" : `${(cutHeight() - data.low[2]).toFixed(2)} m`;
    redraw();
  }
  if (data.ceiling !== null) slider.value = Math.floor(slider.max * (data.ceiling - data.low[2]) / data.extent[2]);
  slider.addEventListener("input", slide);
  document.querySelectorAll("[name=look]").forEach((radio) => radio.addEventListener("change", redraw));

  const boxes = [...document.querySelectorAll("#classes input")];
  function choose() {
    boxes.forEach((box) => { table[4 * box.value + 3] = box.checked ? 255 : 0; });
    redraw();
  }
  boxes.forEach((box) => box.addEventListener("change", choose));
  for (const [name, checked] of [["all", true], ["none", false]]) {
    document.getElementById(name).addEventListener("click", () => {
      boxes.forEach((box) => { box.checked = checked; });
      choose();
    });
  }

  const pointers = new Map();
  const gap = () => { const [p, q] = [...pointers.values()]; return Math.hypot(p.x - q.x, p.y - q.y); };
  const zoom = (factor) => { distance = Math.min(Math.max(distance * factor, 0.02 * reach), 6 * reach); };
  function move(x, y) {
    const metres = 2 * distance * Math.tan(FIELD_OF_VIEW / 2) / Math.min(canvas.clientHeight, canvas.clientWidth);
    const [right, up] = axes();
    centre = centre.map((v, i) => v + metres * (up[i] * y - right[i] * x));
  }
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [x, y, apart] = [event.clientX - before.x, event.clientY - before.y, pointers.size === 2 ? gap() : 0];
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) {
      move(x / 2, y / 2);
      zoom(apart / Math.max(gap(), 1));
    } else if (event.buttons & 6 || event.shiftKey) {
      move(x, y);
    } else {
      azimuth -= 0.007 * x;
      elevation = Math.min(Math.max(elevation + 0.007 * y, -1.5), 1.57);
    }
    redraw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(0.0012 * event.deltaY * (event.deltaMode ? 30 : 1)));
    redraw();
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", () => { goBack(); redraw(); });
  new ResizeObserver(redraw).observe(canvas);
  goBack();
  slide();
  choose();
})();
//]]>
