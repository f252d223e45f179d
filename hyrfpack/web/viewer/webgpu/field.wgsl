// What all passes over the fields share: the counterpart of field.glsl, with the same constants in front. A line with
// EACH in front stands once for every cell of 8 hidden units, with the cell's number in place of $.

@group(0) @binding(0) var<uniform> weights: array<vec4f, WEIGHTS>; // the decoder's numbers, see pack.js
@group(0) @binding(1) var<storage, read> table: array<vec2f>;
// Resolution, first row, rows, whether each vertex has its own row.
@group(0) @binding(2) var<uniform> levels: array<vec4u, LEVELS>;

fn matrix(i: u32) -> mat4x4f {
    return mat4x4f(weights[i], weights[i + 1u], weights[i + 2u], weights[i + 3u]);
}

// ---- the first hidden layer

EACH var<private> a$: vec4f; var<private> b$: vec4f;

fn begin() {
EACH a$ = weights[BIAS_1 + 2u * $u]; b$ = weights[BIAS_1 + 2u * $u + 1u];
}

fn add(value: f32, at: u32) {
EACH a$ += value * weights[at + 2u * $u]; b$ += value * weights[at + 2u * $u + 1u];
}

// Adds what the two features of a level say.
fn add_level(values: vec2f, level: u32) {
    let at = INPUTS + 4u * CELLS * level;
    add(values.x, at);
    add(values.y, at + 2u * CELLS);
}

fn rectify() {
EACH a$ = max(a$, vec4f(0.0)); b$ = max(b$, vec4f(0.0));
}

fn norm(u: vec3f) -> f32 {
    let most = max(max(abs(u.x), abs(u.y)), abs(u.z)); // squares of large numbers would overflow
    return select(length(u), most * length(u / most), most > 1.0);
}

// The features of one level at a point of the unit cube.
fn features(level: vec4u, c: vec3f) -> vec2f {
    let span = f32(level.x - 1u);
    let v = c * span;
    let cell = clamp(floor(v), vec3f(0.0), vec3f(span - 1.0));
    let w = v - cell;
    let dense = level.w == 1u;
    let mask = level.z - 1u;
    let factors = select(vec3u(1u, 2654435761u, 805459861u), vec3u(1u, level.x, level.x * level.x), dense);
    let low = vec3u(cell) * factors;
    let high = low + factors;
    var sides: array<vec2f, 4>;
    for (var k = 0u; k < 4u; k++) {
        let y = select(high.y, low.y, (k & 1u) == 0u);
        let z = select(high.z, low.z, k < 2u);
        let first = select((low.x ^ y ^ z) & mask, low.x + y + z, dense);
        let second = select((high.x ^ y ^ z) & mask, high.x + y + z, dense);
        sides[k] = mix(table[level.y + first], table[level.y + second], w.x);
    }
    return mix(mix(sides[0], sides[1], w.y), mix(sides[2], sides[3], w.y), w.z);
}

// A local position in the unit cube.
fn contract(p: vec3f) -> vec3f {
    let u = p / HALF_EXTENT;
    let r = max(norm(u), 1.0);
    return 0.25 * (2.0 - 1.0 / r) * u / r + 0.5;
}

// Adds what the hash features of a local position say.
fn add_place(p: vec3f) {
    let c = contract(p);
    for (var level = 0u; level < LEVELS; level++) {
        add_level(features(levels[level], c), level);
    }
}

const PI = 3.14159265358979;

fn add_three(values: vec3f, at: u32) {
    add(values.x, at);
    add(values.y, at + 2u * CELLS);
    add(values.z, at + 4u * CELLS);
}

// Adds what an encoded unit vector says.
fn add_direction(d: vec3f) {
    const NEXT = 2u * CELLS;
    if (HARMONICS) {
        const K1 = 0.4886025119029199;
        const K2 = 1.0925484305920792;
        add_three(vec3f(0.28209479177387814, K1 * d.y, K1 * d.z), DIRECTIONS);
        add_three(vec3f(K1 * d.x, K2 * d.x * d.y, K2 * d.y * d.z), DIRECTIONS + 3u * NEXT);
        let last = 0.5462742152960396 * (d.x * d.x - d.y * d.y);
        let zz = 0.31539156525252005 * (3.0 * d.z * d.z - 1.0);
        add_three(vec3f(zz, K2 * d.x * d.z, last), DIRECTIONS + 6u * NEXT);
    } else {
        var s = sin(PI * d);
        var c = cos(PI * d);
        for (var octave = 0u; octave < 4u; octave++) {
            add_three(s, DIRECTIONS + 3u * octave * NEXT);
            add_three(c, DIRECTIONS + (12u + 3u * octave) * NEXT);
            let twice = 2.0 * s;
            s = twice * c;
            c = 1.0 - 0.5 * twice * twice;
        }
    }
}

// ---- what comes after it

// Four units of the second hidden layer.
fn second(group: u32) -> vec4f {
    var sum = weights[BIAS_2 + group];
    let at = MATRIX_2 + 8u * CELLS * group;
EACH sum += matrix(at + 8u * $u) * a$ + matrix(at + 8u * $u + 4u) * b$;
    return max(sum, vec4f(0.0));
}

// The four outputs of the last layer from `bias` and `last` on.
fn last_layer(bias: u32, last: u32) -> vec4f {
    var sum = weights[bias];
    for (var group = 0u; group < 2u * CELLS; group++) {
        sum += matrix(last + 4u * group) * second(group);
    }
    return sum;
}

fn sigmoid(x: vec3f) -> vec3f {
    return 1.0 / (1.0 + exp(-x));
}

const RADIUS = 100.0; // of the background's sphere, in local units

// The background at a place on its sphere, seen along a unit vector.
fn background(place: vec3f, d: vec3f) -> vec3f {
    begin();
    add_place(place);
    add_direction(d);
    rectify();
    return sigmoid(last_layer(BIAS_3, MATRIX_3).xyz);
}
