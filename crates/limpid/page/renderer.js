// Draws Gaussians with WebGL2: one quad each, from far to near. The constants are those of crates/splat-core.

const VERTEX_SHADER = `#version 300 es
precision highp float;
precision highp int;
precision highp isampler2D;
// Three texels of each Gaussian: centre and opacity; covariance xx, xy, xz, yy; and yz, zz, factor of the directional colours.
uniform highp sampler2D shapes;
// Colour of degree 0.
uniform highp sampler2D colors;
// Colours of the other degrees: a texel for every coefficient.
uniform highp isampler2D others;
uniform int shapesAcross, colorsAcross, othersAcross, degree;
uniform mat3 rotation;     // camera from world
uniform vec3 translation, eye;
uniform vec4 lens;         // fx, fy, cx, cy in px
uniform vec4 tangents;     // least and largest x/z and y/z in the Jacobian
uniform vec2 size;         // px
uniform float lowPass;     // px²
layout(location = 0) in uint row;
flat out vec4 tint;
out vec2 offset;           // in standard deviations

ivec2 place(int index, int across) { return ivec2(index % across, index / across); }

vec3 other(int k, int count) {
  return vec3(texelFetch(others, place(int(row) * count + k, othersAcross), 0).rgb);
}

vec3 color(vec3 d, float factor) {
  vec3 sum = 0.28209479177387814 * texelFetch(colors, place(int(row), colorsAcross), 0).rgb + 0.5;
  if (degree == 0) return sum;
  int n = (degree + 1) * (degree + 1) - 1;
  float x = d.x, y = d.y, z = d.z;
  vec3 rest = 0.4886025119029199 * (-y * other(0, n) + z * other(1, n) - x * other(2, n));
  if (degree > 1) {
    float xx = x * x, yy = y * y, zz = z * z;
    rest += 1.0925484305920792 * (x * y * other(3, n) - y * z * other(4, n) - x * z * other(6, n))
      + 0.31539156525252005 * (2.0 * zz - xx - yy) * other(5, n)
      + 0.5462742152960396 * (xx - yy) * other(7, n);
    if (degree > 2) {
      rest += -0.5900435899266435 * y * (3.0 * xx - yy) * other(8, n)
        + 2.890611442640554 * x * y * z * other(9, n)
        - 0.4570457994644658 * y * (4.0 * zz - xx - yy) * other(10, n)
        + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * other(11, n)
        - 0.4570457994644658 * x * (4.0 * zz - xx - yy) * other(12, n)
        + 1.445305721320277 * z * (xx - yy) * other(13, n)
        - 0.5900435899266435 * x * (xx - 3.0 * yy) * other(14, n);
    }
  }
  return sum + rest * factor / 127.0;
}

void main() {
  int first = 3 * int(row);
  vec4 a = texelFetch(shapes, place(first, shapesAcross), 0);
  vec4 b = texelFetch(shapes, place(first + 1, shapesAcross), 0);
  vec4 c = texelFetch(shapes, place(first + 2, shapesAcross), 0);
  vec3 p = rotation * a.xyz + translation;
  vec2 slope = p.xy / p.z;
  vec2 t = clamp(slope, tangents.xy, tangents.zw);
  // Rows of the Jacobian, in the world's axes.
  vec3 j = vec3(lens.x / p.z, 0.0, -lens.x * t.x / p.z) * rotation;
  vec3 k = vec3(0.0, lens.y / p.z, -lens.y * t.y / p.z) * rotation;
  mat3 covariance = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  vec3 cj = covariance * j;
  float xx = dot(j, cj) + lowPass, xy = dot(k, cj), yy = dot(k, covariance * k) + lowPass;
  float half_ = 0.5 * (xx - yy);
  float spread = sqrt(half_ * half_ + xy * xy);
  float large = 0.5 * (xx + yy) + spread;
  float small = max((xx * yy - xy * xy) / large, lowPass);
  vec2 axis = half_ > 0.0 ? vec2(half_ + spread, xy) : vec2(xy, spread - half_);
  axis = spread > 1e-9 * large ? normalize(axis) : vec2(1.0, 0.0);
  // As far as alpha is over its threshold.
  float reach = 1.001 * sqrt(2.0 * max(log(255.0 * a.w), 0.0)) + 0.01;
  offset = reach * vec2(2 * (gl_VertexID & 1) - 1, (gl_VertexID & 2) - 1);
  vec2 pixel = lens.xy * slope + lens.zw + offset.x * sqrt(large) * axis + offset.y * sqrt(small) * vec2(-axis.y, axis.x);
  vec2 clip = 2.0 * pixel / size - 1.0;
  gl_Position = vec4(clip.x, -clip.y, 0.0, 1.0);
  tint = vec4(max(color(normalize(a.xyz - eye), c.z), 0.0), a.w);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;
flat in vec4 tint;
in vec2 offset;
out vec4 result;
void main() {
  float alpha = min(tint.a * exp(-0.5 * dot(offset, offset)), 0.999);
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(tint.rgb * alpha, alpha);
}`;

class Renderer {
  /** `null` where there is no WebGL2. */
  static on(canvas, scene) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    return gl && new Renderer(gl, scene);
  }

  constructor(gl, scene) {
    this.gl = gl;
    this.scene = scene;
    this.build();
  }

  /** Takes another scene in the place of this one. */
  load(scene) {
    const { gl, made } = this;
    for (const texture of made.textures) gl.deleteTexture(texture);
    gl.deleteBuffer(this.order);
    gl.deleteVertexArray(made.lines);
    gl.deleteProgram(made.program);
    this.scene = scene;
    this.build();
  }

  /** Everything that lives on the GPU; again after a lost context. */
  build() {
    const { gl, scene } = this;
    const program = gl.createProgram();
    this.made = { program, textures: [], lines: gl.createVertexArray() };
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      // It stays as long as the program.
      gl.deleteShader(shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`The GPU refuses the shaders: ${gl.getProgramInfoLog(program)}`);
    }
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    const most = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), 4096);
    this.most = gl.getParameter(gl.MAX_TEXTURE_SIZE);

    /** Texels in a line of the texture of shapes, three for each Gaussian. */
    this.shapesAcross = most - (most % 3);
    /** Its floats, whole lines of them. */
    this.shapes = new Float32Array(4 * this.shapesAcross * Math.ceil(3 * scene.count / this.shapesAcross));
    for (let i = 0; i < scene.count; i++) {
      this.shapes[12 * i + 3] = scene.opacities[i];
      this.shapes[12 * i + 10] = scene.factors[i];
    }
    this.texture(0, "shapes", this.shapesAcross, gl.RGBA32F, gl.RGBA, gl.FLOAT, this.shapes);

    const colors = new Float32Array(4 * most * Math.ceil(scene.count / most));
    for (let i = 0; i < scene.count; i++) for (let k = 0; k < 3; k++) colors[4 * i + k] = scene.colors[3 * i + k];
    this.texture(1, "colors", most, gl.RGBA16F, gl.RGBA, gl.FLOAT, colors);

    const { otherColors } = scene;
    const texels = otherColors.length / 3;
    const others = new Int8Array(4 * most * Math.max(Math.ceil(texels / most), 1));
    for (let i = 0; i < texels; i++) for (let k = 0; k < 3; k++) others[4 * i + k] = otherColors[3 * i + k];
    this.texture(2, "others", most, gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, others);
    gl.uniform1i(this.at("degree"), scene.degree);

    this.order = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bindVertexArray(this.made.lines);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(0, 0, 0, 1);
  }

  texture(unit, name, across, internal, format, type, values) {
    const { gl } = this;
    const lines = values.length / 4 / across;
    if (lines > this.most) throw new Error("The scene has more Gaussians than this GPU's textures hold.");
    gl.activeTexture(gl.TEXTURE0 + unit);
    const texture = gl.createTexture();
    this.made.textures.push(texture);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, across, lines, 0, format, type, values);
    gl.uniform1i(this.at(name), unit);
    gl.uniform1i(this.at(`${name}Across`), across);
  }

  /** Brings centres and covariances of the first `count` Gaussians to the GPU. */
  place({ centers, covariances }, count) {
    const { gl, shapes, shapesAcross } = this;
    for (let i = 0, to = 0; i < count; i++, to += 12) {
      const c = 3 * i, v = 6 * i;
      shapes[to] = centers[c]; shapes[to + 1] = centers[c + 1]; shapes[to + 2] = centers[c + 2];
      shapes[to + 4] = covariances[v]; shapes[to + 5] = covariances[v + 1]; shapes[to + 6] = covariances[v + 2]; shapes[to + 7] = covariances[v + 3];
      shapes[to + 8] = covariances[v + 4]; shapes[to + 9] = covariances[v + 5];
    }
    const lines = Math.ceil(3 * count / shapesAcross);
    if (lines === 0) return;
    gl.activeTexture(gl.TEXTURE0);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, shapesAcross, lines, gl.RGBA, gl.FLOAT, shapes);
  }

  /** Draws the first `count` rows of an order into what is bound, from a view. */
  draw(view, order, count) {
    const { gl } = this;
    const { pose: m, width, height, fx, fy, cx, cy } = view;
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (count === 0) return;
    gl.uniformMatrix3fv(this.at("rotation"), true, [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]);
    gl.uniform3f(this.at("translation"), m[3], m[7], m[11]);
    gl.uniform3f(this.at("eye"), ...view.center);
    gl.uniform4f(this.at("lens"), fx, fy, cx, cy);
    const [mx, my] = [0.15 * width / fx, 0.15 * height / fy];
    gl.uniform4f(this.at("tangents"), -cx / fx - mx, -cy / fy - my, (width - cx) / fx + mx, (height - cy) / fy + my);
    gl.uniform2f(this.at("size"), width, height);
    gl.uniform1f(this.at("lowPass"), view.lowPass);
    gl.bufferData(gl.ARRAY_BUFFER, order.subarray(0, count), gl.STREAM_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }

  /** The bytes of a view, RGBA in lines from top to bottom, at its own size and without touching the canvas. */
  pixels(view, order, count) {
    const { gl } = this;
    const { width, height } = view;
    const target = gl.createRenderbuffer();
    const frame = gl.createFramebuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, target);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, target);
    this.draw(view, order, count);
    const flipped = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, flipped);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(frame);
    gl.deleteRenderbuffer(target);
    const bytes = new Uint8ClampedArray(flipped.length);
    for (let y = 0; y < height; y++) bytes.set(flipped.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
    return bytes;
  }
}
