// The colour of each Gaussian as seen from a point.
uniform usampler2DArray u_features; // from features.frag
uniform usampler2D u_places;
uniform sampler2D u_logits; // colour logits; scale logit
uniform vec3 u_eye;

out uvec2 o_color; // halves: red, green; blue

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    begin(BIAS_1);
    for (int first = 0; first < LEVELS; first += 4) {
        uvec4 packed = texelFetch(u_features, ivec3(place, first >> 2), 0);
        for (int k = 0; k < 4 && first + k < LEVELS; ++k) add_level(unpackHalf2x16(packed[k]), first + k);
    }
    vec3 ray = uintBitsToFloat(texelFetch(u_places, place, 0).xyz) - u_eye;
    add_direction(ray / max(length(ray), 1e-12));
    rectify();
    vec4 sum = WEIGHT(BIAS_3);
    for (int group = 0; group < 2 * CELLS; ++group) sum += MATRIX(MATRIX_3 + 4 * group) * second(group);
    vec3 color = sigmoid(sum.xyz + texelFetch(u_logits, place, 0).xyz);
    o_color = uvec2(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0.0)));
}
