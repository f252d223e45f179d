// The hash features of the Gaussians of rows as halves: two of a level in a word, four levels in a vector.

@group(0) @binding(3) var<storage, read> gaussians: array<vec4f>; // x, y, z; opacity logit
@group(0) @binding(4) var<storage, read> rows: array<u32>;
@group(0) @binding(5) var<storage, read_write> packed: array<vec4u>; // layer after layer of four levels

const MAX_HALF = 65504.0;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let i = rows[id.y] * WIDTH + id.x;
    let c = contract(gaussians[i].xyz);
    for (var first = 0u; first < LEVELS; first += 4u) {
        var four = vec4u(0u);
        for (var k = 0u; k < min(4u, LEVELS - first); k++) {
            let values = features(levels[first + k], c);
            four[k] = pack2x16float(clamp(values, vec2f(-MAX_HALF), vec2f(MAX_HALF)));
        }
        packed[(first >> 2u) * CAPACITY + i] = four;
    }
}
