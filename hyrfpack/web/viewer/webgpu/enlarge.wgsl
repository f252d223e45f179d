// A picture, made as large as another one.

@group(0) @binding(0) var coarse: texture_2d<f32>;
@group(0) @binding(1) var smooth_panoramic: sampler;
@group(0) @binding(2) var picture: texture_storage_2d<rgba16float, write>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let size = textureDimensions(picture);
    if (any(id.xy >= size)) {
        return;
    }
    textureStore(picture, id.xy, textureSampleLevel(coarse, smooth_panoramic, (vec2f(id.xy) + 0.5) / vec2f(size), 0.0));
}
