// The mean depth z / (z + scale) at a pixel of blended depths, as 24 bits in red, green and blue; black where there is
// none.

@group(0) @binding(0) var<uniform> place: vec2u;
@group(0) @binding(1) var splats: texture_2d<f32>;

const ALPHA_MIN = 0.1;

@vertex
fn cover(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
    return vec4f(select(-1.0, 3.0, vertex == 1u), select(-1.0, 3.0, vertex == 2u), 0.0, 1.0);
}

@fragment
fn encode() -> @location(0) vec4f {
    let blended = textureLoad(splats, place, 0);
    if (blended.a <= ALPHA_MIN) {
        return vec4f(0.0, 0.0, 0.0, 1.0);
    }
    let bits = u32(clamp(blended.r / blended.a, 0.0, 1.0) * 16777215.0);
    return vec4f(vec3f(vec3u(bits >> 16u, bits >> 8u, bits) & vec3u(255u)) / 255.0, 1.0);
}
