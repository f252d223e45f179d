// The colour of each Gaussian as seen from a point.
uniform usampler2DArray u_features; // from features.frag
uniform usampler2D u_places;
uniform sampler2D u_logits; // colour logits; scale logit
uniform vec3 u_eye;
#ifdef MOVED
uniform mat3 u_place_inverse; // from the axes of the scene to those of the part
#endif
#ifdef RESIDUAL_TERMS
uniform highp sampler2DArray u_residuals; // a layer for each of RESIDUAL_TERMS harmonics

// What the residuals of a Gaussian add to its colour along a direction, see hyrf/basis.js.
vec3 residual(ivec2 place, vec3 d) {
    float[16] basis;
    vec3 s = d * d;
    basis[0] = 0.28209479177387814;
    basis[1] = -0.4886025119029199 * d.y;
    basis[2] = 0.4886025119029199 * d.z;
    basis[3] = -0.4886025119029199 * d.x;
    basis[4] = 1.0925484305920792 * d.x * d.y;
    basis[5] = -1.0925484305920792 * d.y * d.z;
    basis[6] = 0.31539156525252005 * (3.0 * s.z - 1.0);
    basis[7] = -1.0925484305920792 * d.x * d.z;
    basis[8] = 0.5462742152960396 * (s.x - s.y);
    basis[9] = -0.5900435899266435 * d.y * (3.0 * s.x - s.y);
    basis[10] = 2.890611442640554 * d.x * d.y * d.z;
    basis[11] = -0.4570457994644658 * d.y * (5.0 * s.z - 1.0);
    basis[12] = 0.3731763325901154 * d.z * (5.0 * s.z - 3.0);
    basis[13] = -0.4570457994644658 * d.x * (5.0 * s.z - 1.0);
    basis[14] = 1.445305721320277 * d.z * (s.x - s.y);
    basis[15] = -0.5900435899266435 * d.x * (s.x - 3.0 * s.y);
    vec3 sum = vec3(0.0);
    for (int k = 0; k < RESIDUAL_TERMS; ++k) sum += basis[k] * texelFetch(u_residuals, ivec3(place, k), 0).xyz;
    return sum;
}
#endif

out uvec2 o_color; // halves: red, green; blue

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    begin(BIAS_1);
    for (int first = 0; first < LEVELS; first += 4) {
        uvec4 packed = texelFetch(u_features, ivec3(place, first >> 2), 0);
        for (int k = 0; k < 4 && first + k < LEVELS; ++k) add_level(unpackHalf2x16(packed[k]), first + k);
    }
    vec3 ray = uintBitsToFloat(texelFetch(u_places, place, 0).xyz) - u_eye;
    vec3 direction = ray / max(length(ray), 1e-12);
#ifdef MOVED
    direction = u_place_inverse * direction;
#endif
    add_direction(direction);
    rectify();
    vec4 sum = WEIGHT(BIAS_3);
    for (int group = 0; group < 2 * CELLS; ++group) sum += MATRIX(MATRIX_3 + 4 * group) * second(group);
    vec3 color = sigmoid(sum.xyz + texelFetch(u_logits, place, 0).xyz);
#ifdef RESIDUAL_TERMS
    color = max(color + residual(place, direction), 0.0);
#endif
    o_color = uvec2(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0.0)));
}
