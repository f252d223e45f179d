// Draws splats with WebGL 2: project (one fragment a splat), blend (one quad a splat, farthest first), resolve (over
// the background).

const TEXTURE_WIDTH = 2048; // every WebGL 2 has it
const QUADS = 1024; // an instance: drivers are slow with many small instances

class Renderer {
  // Throws an Error with a sentence where the browser cannot do it.
  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser offers no WebGL 2, which drawing needs; switch it on or take another browser.");
    this.gl = gl;
    this.scene = scene;
    // Thousands of layers are blended: 8 bits would round away what faint ones add.
    this.fine = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    gl.getExtension("WEBGL_provoking_vertex")?.provokingVertexWEBGL(0x8e4d); // the first: free of cost everywhere
    this.project = this.program("whole.vert", "project.frag");
    this.blend = this.program("blend.vert", "blend.frag");
    this.resolve = this.program("whole.vert", "resolve.frag");

    // Two triangles for each of the quads of one instance.
    const corners = Uint32Array.from({ length: 6 * QUADS }, (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6]);
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.nothing = gl.createVertexArray();

    this.background = this.texture(gl.TEXTURE_2D, gl.RGBA8, 1, 1);
    this.drawn = 0;
  }

  // Take what the worker unpacked, and the background's picture where there is one.
  load({ places, looks, harmonics, antialiased, height }, picture) {
    const gl = this.gl;
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error(`These are ${this.scene.count.toLocaleString("en")} splats, more than this device can draw.`);
    }
    const size = [TEXTURE_WIDTH, height];
    this.antialiased = antialiased;
    this.places = this.texture(gl.TEXTURE_2D, gl.RGBA32UI, ...size);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...size, gl.RGBA_INTEGER, gl.UNSIGNED_INT, places);
    this.looks = this.texture(gl.TEXTURE_2D, gl.RG32UI, ...size);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...size, gl.RG_INTEGER, gl.UNSIGNED_INT, looks);
    const layers = this.scene.degree;
    this.harmonics = this.texture(gl.TEXTURE_2D_ARRAY, gl.RGBA32UI, ...(layers ? size : [1, 1]), layers || 1);
    if (layers) gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, 0, ...size, layers, gl.RGBA_INTEGER, gl.UNSIGNED_INT, harmonics);

    this.order = this.texture(gl.TEXTURE_2D, gl.R32UI, ...size);
    this.shapes = this.texture(gl.TEXTURE_2D, gl.RGBA32UI, ...size);
    this.appearances = this.texture(gl.TEXTURE_2D, gl.RGBA32UI, ...size);
    this.projection = this.framebuffer(this.shapes, this.appearances);
    this.projectionSize = size;

    if (picture) {
      this.background = this.texture(gl.TEXTURE_2D, gl.RGBA8, picture.naturalWidth, picture.naturalHeight);
      gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, picture);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
      this.smooth(gl.TEXTURE_2D);
    }
    this.sphere = Boolean(picture);
    if (gl.getError() !== gl.NO_ERROR) throw new Error("The scene does not fit into the memory of the graphics device.");
  }

  // Take an order: indices of splats, farthest first, of which the first `drawn` count; whole rows of the texture.
  sorted(order, drawn) {
    const gl = this.gl, rows = Math.ceil(drawn / TEXTURE_WIDTH);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    this.drawn = drawn;
  }

  // Draw a view to the canvas, splats at `scale` times its resolution.
  draw(view, scale) {
    const size = [view.width, view.height].map((side) => Math.max(1, Math.round(side * scale)));
    this.splats(resized(view, ...size));
    this.over(view, size, null);
  }

  // Draw a view and read it: RGB, top row first.
  read(view) {
    const gl = this.gl, { width, height } = view;
    const texture = this.texture(gl.TEXTURE_2D, gl.RGBA8, width, height);
    const target = this.framebuffer(texture);
    this.splats(view);
    this.over(view, [width, height], target);
    const rgba = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    gl.deleteFramebuffer(target);
    gl.deleteTexture(texture);
    return rgba.filter((_, place) => (place & 3) !== 3);
  }

  // How deep what is seen at a pixel lies, null where there is nothing. `scale` of depths of interest.
  pick(view, x, y, scale) {
    const gl = this.gl;
    const place = [Math.floor(x), Math.floor(y), 1, 1];
    this.splats(view, scale, place);
    const found = this.fine ? new Float32Array(4) : new Uint8Array(4);
    gl.readPixels(...place, gl.RGBA, this.fine ? gl.FLOAT : gl.UNSIGNED_BYTE, found);
    const [value, , , alpha] = found;
    const share = value / alpha; // z / (z + scale)
    return alpha > (this.fine ? 0.1 : 25) && share < 1 ? (scale * share) / (1 - share) : null;
  }

  // Whether the last frame is still being drawn.
  busy() {
    const gl = this.gl;
    if (!this.fence) return false;
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED && !gl.isContextLost()) return true;
    gl.deleteSync(this.fence);
    this.fence = null;
    return false;
  }

  // Blend the splats of a view; with `pick`, depths instead of colours, at the pixels of `part` (x, y, width, height).
  splats(view, pick = 0, part = [0, 0, view.width, view.height]) {
    const gl = this.gl, { width, height } = view;
    this.projections(view, pick);
    this.reserve(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.layers);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...part);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.blend.program);
    this.bind(this.blend, { u_order: this.order, u_shapes: this.shapes, u_projected: this.appearances });
    gl.uniform2f(this.blend.u_size, width, height);
    gl.uniform1i(this.blend.u_drawn, this.drawn);
    gl.uniform1i(this.blend.u_quads, QUADS);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.quads);
    const instances = Math.ceil(this.drawn / QUADS);
    if (instances) gl.drawElementsInstanced(gl.TRIANGLES, 6 * QUADS, gl.UNSIGNED_INT, 0, instances);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
  }

  projections(view, pick) {
    const gl = this.gl, p = this.project, { rows } = view;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projection);
    gl.viewport(0, 0, ...this.projectionSize);
    gl.useProgram(p.program);
    this.bind(p, { u_places: this.places, u_looks: this.looks });
    this.bind(p, { u_harmonics: this.harmonics }, gl.TEXTURE_2D_ARRAY, 2);
    gl.uniform1i(p.u_degree, this.scene.degree);
    gl.uniform1i(p.u_count, this.scene.count);
    gl.uniform1i(p.u_antialiased, this.antialiased);
    gl.uniformMatrix3fv(p.u_rotation, true, rows.flat());
    gl.uniform3fv(p.u_translation, view.translation);
    gl.uniform3fv(p.u_eye, view.eye);
    gl.uniform4f(p.u_intrinsics, view.fx, view.fy, view.cx, view.cy);
    gl.uniform2f(p.u_size, view.width, view.height);
    gl.uniform1f(p.u_near, this.scene.near);
    gl.uniform1f(p.u_tolerance, this.scene.tolerance);
    gl.uniform1f(p.u_pick, pick);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  over(view, used, target) {
    const gl = this.gl, r = this.resolve;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, view.width, view.height);
    gl.useProgram(r.program);
    this.bind(r, { u_splats: this.layered, u_background: this.background });
    gl.uniform2f(r.u_used, ...used);
    gl.uniform1i(r.u_sphere, this.sphere);
    gl.uniform3fv(r.u_solid, this.scene.solid);
    gl.uniformMatrix3fv(r.u_world, false, view.rows.flatMap(turned)); // rows read as columns: transposed
    gl.uniform4f(r.u_intrinsics, view.fx, view.fy, view.cx, view.cy);
    gl.uniform2f(r.u_size, view.width, view.height);
    gl.uniform1i(r.u_upright, target === null);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (target === null && !this.fence) {
      this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
      gl.flush();
    }
  }

  // A target for the splats, at least so large.
  reserve(width, height) {
    const gl = this.gl;
    const [w, h] = this.reserved ?? [0, 0];
    if (width <= w && height <= h) return;
    this.reserved = [Math.max(w, width), Math.max(h, height)];
    if (this.layered) gl.deleteTexture(this.layered);
    if (this.layers) gl.deleteFramebuffer(this.layers);
    this.layered = this.texture(gl.TEXTURE_2D, this.fine ? gl.RGBA16F : gl.RGBA8, ...this.reserved);
    this.smooth(gl.TEXTURE_2D);
    this.layers = this.framebuffer(this.layered);
  }

  texture(kind, format, width, height, depth) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(kind, texture);
    if (depth) gl.texStorage3D(kind, 1, format, width, height, depth);
    else gl.texStorage2D(kind, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  smooth(kind) {
    const gl = this.gl;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, gl.LINEAR);
  }

  framebuffer(...textures) {
    const gl = this.gl, framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const places = textures.map((_, number) => gl.COLOR_ATTACHMENT0 + number);
    places.forEach((place, number) => gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, textures[number], 0));
    gl.drawBuffers(places);
    return framebuffer;
  }

  bind(program, textures, kind = this.gl.TEXTURE_2D, first = 0) {
    const gl = this.gl;
    Object.entries(textures).forEach(([name, texture], number) => {
      gl.activeTexture(gl.TEXTURE0 + first + number);
      gl.bindTexture(kind, texture);
      gl.uniform1i(program[name], first + number);
    });
    gl.activeTexture(gl.TEXTURE7); // nothing is bound here by others
  }

  // A program and its uniforms by name.
  program(...names) {
    const gl = this.gl, program = gl.createProgram();
    for (const name of names) {
      const shader = gl.createShader(name.endsWith(".vert") ? gl.VERTEX_SHADER : gl.FRAGMENT_SHADER);
      gl.shaderSource(shader, textOf(name));
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader)).join(" ");
      throw new Error(`The graphics driver refuses ${names.join(" and ")}: ${gl.getProgramInfoLog(program)} ${logs}`);
    }
    const found = { program };
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      found[name] = gl.getUniformLocation(program, name);
    }
    return found;
  }
}

// A view in a picture of another resolution.
function resized(view, width, height) {
  const x = width / view.width, y = height / view.height;
  if (x === 1 && y === 1) return view;
  return { ...view, width, height, fx: view.fx * x, fy: view.fy * y, cx: view.cx * x, cy: view.cy * y };
}
