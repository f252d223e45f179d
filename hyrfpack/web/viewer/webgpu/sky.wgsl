// The background at nodes of a grid, which are pixel centres, where it is needed; elsewhere black. Alpha is 1.

struct Tile {
    origin: vec2u,
    size: vec2u, // of the tile
    eye: vec4f, // stride of the nodes in pixels last
    world: array<vec4f, 3>, // rows of the rotation from world to camera
    intrinsics: vec4f, // fx, fy, cx, cy in pixels
}

@group(0) @binding(3) var<uniform> tile: Tile;
@group(0) @binding(4) var needed: texture_2d<f32>; // from needed.wgsl
@group(0) @binding(5) var picture: texture_storage_2d<rgba16float, write>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if (any(id.xy >= tile.size)) {
        return;
    }
    let node = tile.origin + id.xy;
    var color = vec3f(0.0);
    if (textureLoad(needed, node, 0).x > 0.0) {
        let pixel = tile.eye.w * vec2f(node) + 0.5;
        let slope = vec3f((pixel - tile.intrinsics.zw) / tile.intrinsics.xy, 1.0);
        let ray = normalize(slope.x * tile.world[0].xyz + slope.y * tile.world[1].xyz + tile.world[2].xyz);
        let eye = tile.eye.xyz / RADIUS;
        let along = dot(eye, ray);
        let place = eye + (sqrt(max(along * along - dot(eye, eye) + 1.0, 0.0)) - along) * ray;
        color = background(RADIUS * place, ray);
    }
    textureStore(picture, node, vec4f(color, 1.0));
}
