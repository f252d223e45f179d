// Marks the nodes of a grid from which a pixel that shows the background is interpolated, as needed.frag does.

struct Grid {
    last: vec2i, // the last pixel
    stride: i32, // of the nodes in pixels
    all: i32, // 1 to mark all nodes
}

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var splats: texture_2d<f32>; // blended, one texel a pixel
@group(0) @binding(2) var marks: texture_storage_2d<r32float, write>;

const THRESHOLD = 1.0 / 512.0; // of the light that passes, as in hyrfpack render

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if (any(id.xy >= textureDimensions(marks))) {
        return;
    }
    let node = grid.stride * vec2i(id.xy);
    let first = max(node - grid.stride + 1, vec2i(0));
    let last = min(node + grid.stride - 1, grid.last);
    var alpha = 1.0 - f32(grid.all);
    for (var y = first.y; y <= last.y; y++) {
        for (var x = first.x; x <= last.x; x++) {
            alpha = min(alpha, textureLoad(splats, vec2i(x, y), 0).a);
        }
    }
    textureStore(marks, id.xy, vec4f(select(0.0, 1.0, 1.0 - alpha > THRESHOLD)));
}
