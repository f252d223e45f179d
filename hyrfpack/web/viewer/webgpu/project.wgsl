// Projects the Gaussians of a model to the picture, as project.frag does, and makes the keys of their order of depth.

struct View {
    rotation: array<vec4f, 3>, // rows: camera from page; the translation last
    intrinsics: vec4f, // fx, fy, cx, cy in pixels
    size: vec2f,
    near: f32,
    tolerance: f32, // band around the picture in which centres may lie, as a fraction of half its size
    low_pass: vec4f, // variances in px^2 along x and y: at full resolution, and with the mean over blocks of it
    focal: f32, // max(fx, fy) of the picture at full resolution
    pick: f32, // > 0: instead of a colour, z / (z + pick)
    alpha_min: f32,
    antialiased: f32,
    count: u32,
}

struct Splat {
    variances: vec3f, // xx, xy, yy in px^2
    determinant: f32, // of the covariance
    center: vec2f, // pixels
    color: vec2u, // halves: red, green; blue, opacity
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> places: array<vec4u>;
@group(0) @binding(2) var<storage, read> shapes: array<vec4u>;
@group(0) @binding(3) var<storage, read> colors: array<vec2u>;
@group(0) @binding(4) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(5) var<storage, read_write> keys: array<u32>; // for sort.wgsl

const SKIPPED = 0xffffffffu;
const COMPENSATION_MIN = 2.5e-5;
const SAMPLING_VARIANCE = 0.4; // px^2 of the photos

fn rotation(q: vec4f) -> mat3x3f {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3f(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y),
    );
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
    let i = id.y * groups.x * 64u + id.x;
    if (i >= view.count) {
        return;
    }
    keys[i] = SKIPPED;
    let words = places[i];
    let mean = bitcast<vec3f>(words.xyz);
    let camera = transpose(mat3x3f(view.rotation[0].xyz, view.rotation[1].xyz, view.rotation[2].xyz));
    let p = camera * mean + vec3f(view.rotation[0].w, view.rotation[1].w, view.rotation[2].w);
    let focal = view.intrinsics.xy;
    let principal = view.intrinsics.zw;
    let margin = 0.5 * view.tolerance * view.size;
    let low = (-margin - principal) * p.z;
    let high = (view.size + margin - principal) * p.z;
    if (!(p.z > view.near && all(focal * p.xy > low) && all(focal * p.xy < high))) {
        return;
    }

    let shape = shapes[i];
    let last = unpack2x16unorm(words.w);
    var opacity = last.x;
    var scales = exp(vec3f(unpack2x16unorm(shape.z), last.y) * 44.0 - 22.0);
    var quat = vec4f(unpack2x16snorm(shape.x), unpack2x16snorm(shape.y));
    quat /= max(length(quat), 1e-12);

    // No detail is finer than the photos' pixels.
    let size = bitcast<f32>(shape.w);
    let own = p.z / view.focal;
    let added = SAMPLING_VARIANCE * (size * size - own * own);
    if (added > 0.0) {
        let squares = scales * scales;
        let kept = squares / (squares + added);
        if (view.antialiased > 0.0) { // of the two longest axes
            opacity *= sqrt(max(kept.x * kept.y, max(kept.y * kept.z, kept.z * kept.x)));
        }
        scales = sqrt(squares + added);
    }

    let slope = p.xy / p.z;
    let slack = 0.15 * view.size / focal;
    let bent = clamp(slope, -principal / focal - slack, (view.size - principal) / focal + slack);
    let axes = camera * rotation(quat);
    let rows = transpose(mat3x3f(axes[0] * scales.x, axes[1] * scales.y, axes[2] * scales.z));
    let first = focal.x / p.z * (rows[0] - bent.x * rows[2]);
    let second = focal.y / p.z * (rows[1] - bent.y * rows[2]);

    let xx = dot(first, first);
    let xy = dot(first, second);
    let yy = dot(second, second);
    let normal = cross(first, second); // free of the cancellation in xx yy - xy^2
    let determinant = dot(normal, normal);
    let extra = view.low_pass;
    let filtered = determinant + extra.xz * yy + extra.yw * xx + extra.xz * extra.yw;
    opacity *= sqrt(filtered.x / filtered.y); // 1 at full resolution
    if (view.antialiased > 0.0) {
        opacity *= sqrt(max(determinant / filtered.x, COMPENSATION_MIN));
    }

    let halves = colors[i];
    var color = vec3f(unpack2x16float(halves.x), unpack2x16float(halves.y).x);
    color = clamp(color, vec3f(0.0), vec3f(100.0)); // far below what halves hold
    if (view.pick > 0.0) {
        color = vec3f(p.z / (p.z + view.pick));
    }
    let packed = vec2u(pack2x16float(color.rg), pack2x16float(vec2f(color.b, opacity)));
    if (unpack2x16float(packed.y).y < view.alpha_min) {
        return;
    }
    let variances = vec3f(xx + extra.z, xy, yy + extra.w);
    splats[i] = Splat(variances, filtered.y, focal * slope + principal, packed);
    keys[i] = ~bitcast<u32>(p.z); // far ones first
}
