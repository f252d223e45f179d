// Opacity, scales and rotation of the Gaussians of rows, which no view changes, as geometry.frag packs them.

@group(0) @binding(3) var<storage, read> gaussians: array<vec4f>; // x, y, z; opacity logit
@group(0) @binding(4) var<storage, read> logits: array<vec4f>; // colour logits; scale logit
@group(0) @binding(5) var<storage, read> pixel_sizes: array<f32>; // of the photos, from hyrf/sampling.js
@group(0) @binding(6) var<storage, read> residuals: array<vec4f>; // two layers: a, b, x; y, z
@group(0) @binding(7) var<storage, read> rows: array<u32>;
@group(0) @binding(8) var<storage, read_write> places: array<vec4u>;
@group(0) @binding(9) var<storage, read_write> shapes: array<vec4u>;

fn log_sigmoid(x: vec3f) -> vec3f {
    return min(x, vec3f(0.0)) - log(1.0 + exp(-abs(x)));
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let i = rows[id.y] * WIDTH + id.x;
    let own = gaussians[i];
    let logit = logits[i].w;
    begin();
    add_place(own.xyz);
    rectify();
    var first = weights[BIAS_3];
    var last = weights[BIAS_3 + 1u];
    for (var group = 0u; group < 2u * CELLS; group++) {
        let units = second(group);
        first += matrix(MATRIX_3 + 4u * group) * units;
        last += matrix(MATRIX_3 + 8u * CELLS + 4u * group) * units;
    }
    if (RESIDUAL_TERMS > 0u) {
        let one = residuals[i].xyz;
        let axis = vec3f(one.z, residuals[i + CAPACITY].xy);
        let w = last.x + 1.0;
        first += vec4f(0.0, one.xy, -one.x - one.y);
        last += vec4f(-dot(last.yzw, axis), w * axis + cross(last.yzw, axis));
    }
    var scales: vec3f;
    if (PRODUCT) {
        scales = log_sigmoid(first.yzw) + log_sigmoid(vec3f(logit));
    } else {
        scales = log_sigmoid(first.yzw + logit);
    }
    if (GROWS) {
        scales += log(max(1.0, norm(own.xyz / HALF_EXTENT)));
    }
    scales = (scales + 22.0) / 44.0;
    var quat = last + vec4f(1.0, 0.0, 0.0, 0.0);
    quat /= max(length(quat), 1e-12);
    let opacity = 1.0 / (1.0 + exp(-first.x - own.w));
    places[i] = vec4u(bitcast<vec3u>(own.xyz), pack2x16unorm(vec2f(opacity, scales.z)));
    let turn = vec2u(pack2x16snorm(quat.xy), pack2x16snorm(quat.zw));
    shapes[i] = vec4u(turn, pack2x16unorm(scales.xy), bitcast<u32>(pixel_sizes[i]));
}
