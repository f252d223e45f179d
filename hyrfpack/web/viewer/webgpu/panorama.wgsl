// The background all around, as panorama.frag draws it: tiles of an equirectangular picture of its sphere.

struct Tile {
    origin: vec2u,
    size: vec2u, // of the tile
    eye: vec4f,
}

@group(0) @binding(3) var<uniform> tile: Tile;
@group(0) @binding(4) var picture: texture_storage_2d<rgba16float, write>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if (any(id.xy >= tile.size)) {
        return;
    }
    let texel = tile.origin + id.xy;
    let place = (vec2f(texel) + 0.5) / vec2f(textureDimensions(picture));
    let longitude = (2.0 * place.x - 1.0) * PI;
    let latitude = (0.5 - place.y) * PI;
    let d = vec3f(cos(latitude) * sin(longitude), -sin(latitude), cos(latitude) * cos(longitude));
    textureStore(picture, texel, vec4f(background(RADIUS * d, normalize(RADIUS * d - tile.eye.xyz)), 1.0));
}
