// The colour of each Gaussian of rows as seen from a point.

@group(0) @binding(3) var<storage, read> gaussians: array<vec4f>; // x, y, z; opacity logit
@group(0) @binding(4) var<storage, read> logits: array<vec4f>; // colour logits; scale logit
@group(0) @binding(5) var<storage, read> packed: array<vec4u>; // from features.wgsl
@group(0) @binding(6) var<storage, read> residuals: array<vec4f>; // a layer for each of RESIDUAL_TERMS harmonics
@group(0) @binding(7) var<storage, read> rows: array<u32>;
@group(0) @binding(8) var<uniform> eye: vec4f;
@group(0) @binding(9) var<storage, read_write> colors: array<vec2u>; // halves: red, green; blue

// What the residuals of a Gaussian add to its colour along a direction, see hyrf/basis.js.
fn residual(i: u32, d: vec3f) -> vec3f {
    let s = d * d;
    let basis = array<f32, 16>(
        0.28209479177387814,
        -0.4886025119029199 * d.y,
        0.4886025119029199 * d.z,
        -0.4886025119029199 * d.x,
        1.0925484305920792 * d.x * d.y,
        -1.0925484305920792 * d.y * d.z,
        0.31539156525252005 * (3.0 * s.z - 1.0),
        -1.0925484305920792 * d.x * d.z,
        0.5462742152960396 * (s.x - s.y),
        -0.5900435899266435 * d.y * (3.0 * s.x - s.y),
        2.890611442640554 * d.x * d.y * d.z,
        -0.4570457994644658 * d.y * (5.0 * s.z - 1.0),
        0.3731763325901154 * d.z * (5.0 * s.z - 3.0),
        -0.4570457994644658 * d.x * (5.0 * s.z - 1.0),
        1.445305721320277 * d.z * (s.x - s.y),
        -0.5900435899266435 * d.x * (s.x - 3.0 * s.y),
    );
    var sum = vec3f(0.0);
    for (var k = 0u; k < RESIDUAL_TERMS; k++) {
        sum += basis[k] * residuals[k * CAPACITY + i].xyz;
    }
    return sum;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let i = rows[id.y] * WIDTH + id.x;
    begin();
    for (var first = 0u; first < LEVELS; first += 4u) {
        let four = packed[(first >> 2u) * CAPACITY + i];
        for (var k = 0u; k < min(4u, LEVELS - first); k++) {
            add_level(unpack2x16float(four[k]), first + k);
        }
    }
    let ray = gaussians[i].xyz - eye.xyz;
    let direction = ray / max(length(ray), 1e-12);
    add_direction(direction);
    rectify();
    var color = sigmoid(last_layer(BIAS_3, MATRIX_3).xyz + logits[i].xyz);
    if (RESIDUAL_TERMS > 0u) {
        color = max(color + residual(i, direction), vec3f(0.0));
    }
    colors[i] = vec2u(pack2x16float(color.rg), pack2x16float(vec2f(color.b, 0.0)));
}
