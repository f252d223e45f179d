// The blended splats over the background, exposed: the counterpart of resolve.frag.

struct Scene {
    world: array<vec4f, 3>, // rows of the rotation from world to camera
    intrinsics: vec4f, // fx, fy, cx, cy in pixels of the target
    eye: vec3f, // in units of the sphere's radius, from its centre
    pictured: f32, // 1: the background is a picture, else a colour
    solid: vec3f,
    origin: f32, // place of the target's corner in the sky, in texels
    gains: vec3f, // of the exposure; 1 changes nothing
    stride: vec2f, // pixels of the target between nodes of the sky; 0: there is none
}

@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var splats: texture_2d<f32>; // premultiplied, row 0 on top, one texel a pixel
@group(0) @binding(2) var panorama: texture_2d<f32>; // equirectangular, on a sphere
@group(0) @binding(3) var sky: texture_2d<f32>; // instead, between nodes whose alpha is 1
@group(0) @binding(4) var smooth_panoramic: sampler;
@group(0) @binding(5) var smooth_clamped: sampler;

const PI = 3.14159265358979;

@vertex
fn cover(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
    return vec4f(select(-1.0, 3.0, vertex == 1u), select(-1.0, 3.0, vertex == 2u), 0.0, 1.0);
}

// Along a ray: what the sphere shows where it ends.
fn background(ray: vec3f) -> vec3f {
    let along = dot(scene.eye, ray);
    let reach = sqrt(max(along * along - dot(scene.eye, scene.eye) + 1.0, 0.0)) - along;
    let d = normalize(scene.eye + reach * ray);
    let longitude = atan2(d.x, d.z);
    let latitude = asin(clamp(-d.y, -1.0, 1.0));
    let place = vec2f(0.5 + longitude / (2.0 * PI), 0.5 - latitude / PI);
    return textureSampleLevel(panorama, smooth_panoramic, place, 0.0).rgb;
}

@fragment
fn resolve(@builtin(position) position: vec4f) -> @location(0) vec4f {
    let pixel = position.xy;
    let front = textureLoad(splats, vec2u(pixel), 0);
    var behind = scene.solid;
    var nodes = vec4f(0.0);
    if (scene.stride.x > 0.0) {
        let place = (scene.origin + pixel / scene.stride) / vec2f(textureDimensions(sky));
        nodes = textureSampleLevel(sky, smooth_clamped, place, 0.0);
    }
    if (nodes.a > 0.99) {
        behind = nodes.rgb;
    } else if (scene.pictured > 0.0) {
        let slope = (pixel - scene.intrinsics.zw) / scene.intrinsics.xy;
        let world = scene.world;
        behind = background(normalize(slope.x * world[0].xyz + slope.y * world[1].xyz + world[2].xyz));
    }
    let color = clamp(front.rgb + (1.0 - front.a) * behind, vec3f(0.0), vec3f(1.0));
    return vec4f(scene.gains * color / (1.0 + (scene.gains - 1.0) * color), 1.0);
}
