// The quads of splats, farthest first, and a splat at a pixel, premultiplied: the counterpart of blend.vert and
// blend.frag.

struct Splat {
    variances: vec3f, // xx, xy, yy in px^2
    determinant: f32, // of the covariance
    center: vec2f, // pixels
    color: vec2u, // halves: red, green; blue, opacity
}

struct Picture {
    size: vec2f,
    alpha_min: f32,
}

struct Corner {
    @builtin(position) position: vec4f,
    @location(0) @interpolate(flat) center: vec2f,
    @location(1) @interpolate(flat) conic: vec3f,
    @location(2) @interpolate(flat) color: vec4f, // opacity last
}

@group(0) @binding(0) var<uniform> picture: Picture;
@group(0) @binding(1) var<storage, read> order: array<vec2u>; // key and index
@group(0) @binding(2) var<storage, read> splats: array<Splat>;

const SLACK = 0.1; // pixels: quads are snapped to a fraction of a pixel
const CORNERS = array(0u, 1u, 2u, 2u, 1u, 3u); // of the two triangles

@vertex
fn place_corner(@builtin(vertex_index) vertex: u32) -> Corner {
    let splat = splats[order[vertex / 6u].y];
    let color = vec4f(unpack2x16float(splat.color.x), unpack2x16float(splat.color.y));
    let xx = splat.variances.x;
    let xy = splat.variances.y;
    let yy = splat.variances.z;
    let larger = 0.5 * (xx + yy) + length(vec2f(0.5 * (xx - yy), xy));
    var axis = select(vec2f(xy, larger - xx), vec2f(larger - yy, xy), xx > yy);
    axis = select(vec2f(1.0, 0.0), normalize(axis), dot(axis, axis) > 0.0);
    let reach = 2.0 * log(color.a / picture.alpha_min);
    var extent = sqrt(reach * vec2f(larger, splat.determinant / larger)) + SLACK;
    extent = min(extent, vec2f(1.5 * (picture.size.x + picture.size.y))); // centres are near: this covers the picture
    var corners = CORNERS;
    let corner = corners[vertex % 6u];
    let side = vec2f(vec2u(corner & 1u, corner >> 1u)) * 2.0 - 1.0;
    let pixel = splat.center + side.x * extent.x * axis + side.y * extent.y * vec2f(-axis.y, axis.x);
    let position = vec4f(vec2f(2.0, -2.0) * pixel / picture.size + vec2f(-1.0, 1.0), 0.0, 1.0); // row 0 is on top
    return Corner(position, splat.center, vec3f(yy, -xy, xx) / splat.determinant, color);
}

@fragment
fn blend(corner: Corner) -> @location(0) vec4f {
    let d = corner.center - corner.position.xy;
    let conic = corner.conic;
    let power = min(0.0, -0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) - conic.y * d.x * d.y);
    let alpha = min(0.99, corner.color.a * exp(power));
    if (!(alpha >= picture.alpha_min)) { // what overflowed is not drawn either
        discard;
    }
    return vec4f(corner.color.rgb * alpha, alpha);
}
