// What all passes over the fields share: hash grids and decoders for one fragment (docs/reference/format.md 2.3, 2.4, 2.7).
// A line with EACH in front stands once for every cell of 8 hidden units, with the cell's number in place of $.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp usampler2DArray;

// The decoder's numbers, see pack.js.
#ifdef IN_BLOCK
layout(std140) uniform Weights { vec4 u_weights[WEIGHTS]; };
#define WEIGHT(i) u_weights[i]
#else
uniform sampler2D u_weights; // 1,024 wide
#define WEIGHT(i) texelFetch(u_weights, ivec2((i) & 1023, (i) >> 10), 0)
#endif
#define MATRIX(i) mat4(WEIGHT(i), WEIGHT((i) + 1), WEIGHT((i) + 2), WEIGHT((i) + 3))

// ---- the first hidden layer

EACH vec4 a$, b$;

void begin(int at) {
EACH a$ = WEIGHT(at + 2 * $); b$ = WEIGHT(at + 2 * $ + 1);
}

void add(float value, int at) {
EACH a$ += value * WEIGHT(at + 2 * $); b$ += value * WEIGHT(at + 2 * $ + 1);
}

// Add what the two features of a level say.
void add_level(vec2 values, int level) {
    int at = INPUTS + 4 * CELLS * level;
    add(values.x, at);
    add(values.y, at + 2 * CELLS);
}

void rectify() {
EACH a$ = max(a$, 0.0); b$ = max(b$, 0.0);
}

#ifdef PLACES
uniform vec3 u_half_extent;
uniform sampler2D u_table; // rows of two numbers; 2,048 wide
uniform uvec4 u_levels[LEVELS]; // resolution, first row, rows, whether each vertex has its own

float norm(vec3 u) {
    float most = max(max(abs(u.x), abs(u.y)), abs(u.z)); // squares of large numbers would overflow
    return most > 1.0 ? most * length(u / most) : length(u);
}

vec2 row(uint index) {
    return texelFetch(u_table, ivec2(int(index & 2047u), int(index >> 11)), 0).xy;
}

// The features of one level at a point of the unit cube.
vec2 features(uvec4 level, vec3 c) {
    float span = float(level.x - 1u);
    vec3 v = c * span;
    vec3 cell = clamp(floor(v), 0.0, span - 1.0);
    vec3 w = v - cell;
    bool dense = level.w == 1u;
    uvec3 factors = dense ? uvec3(1u, level.x, level.x * level.x) : uvec3(1u, 2654435761u, 805459861u);
    uvec3 low = uvec3(cell) * factors, high = low + factors;
    vec2 sides[4];
    for (int k = 0; k < 4; ++k) {
        uint y = (k & 1) == 0 ? low.y : high.y, z = k < 2 ? low.z : high.z;
        uint first = dense ? low.x + y + z : (low.x ^ y ^ z) & (level.z - 1u);
        uint second = dense ? high.x + y + z : (high.x ^ y ^ z) & (level.z - 1u);
        sides[k] = mix(row(level.y + first), row(level.y + second), w.x);
    }
    return mix(mix(sides[0], sides[1], w.y), mix(sides[2], sides[3], w.y), w.z);
}

// A local position in the unit cube.
vec3 contract(vec3 p) {
    vec3 u = p / u_half_extent;
    float r = max(norm(u), 1.0);
    return 0.25 * (2.0 - 1.0 / r) * u / r + 0.5;
}

// Add what the hash features of a local position say.
void add_place(vec3 p) {
    vec3 c = contract(p);
    for (int level = 0; level < LEVELS; ++level) add_level(features(u_levels[level], c), level);
}
#endif

#ifdef DIRECTIONS
const float PI = 3.14159265358979;
const int NEXT = 2 * CELLS;

void add_three(vec3 values, int at) {
    add(values.x, at);
    add(values.y, at + NEXT);
    add(values.z, at + 2 * NEXT);
}

// Add what an encoded unit vector says.
void add_direction(vec3 d) {
#ifdef HARMONICS
    const float K1 = 0.4886025119029199, K2 = 1.0925484305920792;
    add_three(vec3(0.28209479177387814, K1 * d.y, K1 * d.z), DIRECTIONS);
    add_three(vec3(K1 * d.x, K2 * d.x * d.y, K2 * d.y * d.z), DIRECTIONS + 3 * NEXT);
    vec3 last = vec3(0.31539156525252005 * (3.0 * d.z * d.z - 1.0), K2 * d.x * d.z, 0.0);
    last.z = 0.5462742152960396 * (d.x * d.x - d.y * d.y);
    add_three(last, DIRECTIONS + 6 * NEXT);
#else
    vec3 s = sin(PI * d), c = cos(PI * d);
    for (int octave = 0; octave < 4; ++octave) {
        add_three(s, DIRECTIONS + 3 * octave * NEXT);
        add_three(c, DIRECTIONS + (12 + 3 * octave) * NEXT);
        vec3 twice = 2.0 * s;
        s = twice * c;
        c = 1.0 - 0.5 * twice * twice;
    }
#endif
}
#endif

// ---- what comes after it

#ifdef BIAS_2
// Four units of the second hidden layer.
vec4 second(int group) {
    vec4 sum = WEIGHT(BIAS_2 + group);
    int at = MATRIX_2 + 8 * CELLS * group;
EACH sum += MATRIX(at + 8 * $) * a$ + MATRIX(at + 8 * $ + 4) * b$;
    return max(sum, 0.0);
}
#endif

vec3 sigmoid(vec3 x) {
    return 1.0 / (1.0 + exp(-x));
}

#ifdef BACKGROUND
const float RADIUS = 100.0; // of the background's sphere, in local units

// The background at a place on its sphere, seen along a unit vector.
vec3 background(vec3 place, vec3 d) {
    begin(BIAS_1);
    add_place(place);
    add_direction(d);
    rectify();
    vec4 sum = WEIGHT(BIAS_3);
    for (int group = 0; group < 2 * CELLS; ++group) sum += MATRIX(MATRIX_3 + 4 * group) * second(group);
    return sigmoid(sum.xyz);
}
#endif
