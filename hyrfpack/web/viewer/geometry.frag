// Opacity, scales and rotation of each Gaussian, which no view changes.
uniform sampler2D u_explicit; // x, y, z; opacity logit
uniform sampler2D u_logits; // colour logits; scale logit
uniform sampler2D u_pixel_sizes; // of the photos, from hyrf/sampling.js
#ifdef RESIDUAL_TERMS
uniform highp sampler2DArray u_residuals; // two layers: a, b, x; y, z
#endif
#ifdef MOVED // the part's place in the scene, see hyrf/places.js
uniform mat3 u_place_rows;
uniform vec4 u_place_quat;
uniform vec3 u_place_shift;
uniform float u_place_scale;
#endif
uniform bool u_product; // the scale rule, else the sum
uniform bool u_grows; // the largest scale, outwards

layout(location = 0) out uvec4 o_place; // as project.frag has them
layout(location = 1) out uvec4 o_shape;

vec3 log_sigmoid(vec3 x) {
    return min(x, 0.0) - log(1.0 + exp(-abs(x)));
}

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    vec4 own = texelFetch(u_explicit, place, 0);
    float logit = texelFetch(u_logits, place, 0).w;
    begin(BIAS_1);
    add_place(own.xyz);
    rectify();
    vec4 first = WEIGHT(BIAS_3), last = WEIGHT(BIAS_3 + 1);
    for (int group = 0; group < 2 * CELLS; ++group) {
        vec4 units = second(group);
        first += MATRIX(MATRIX_3 + 4 * group) * units;
        last += MATRIX(MATRIX_3 + 8 * CELLS + 4 * group) * units;
    }
#ifdef RESIDUAL_TERMS
    vec3 one = texelFetch(u_residuals, ivec3(place, 0), 0).xyz, two = texelFetch(u_residuals, ivec3(place, 1), 0).xyz;
    vec3 axis = vec3(one.z, two.xy);
    float w = last.x + 1.0;
    first.yzw += vec3(one.xy, -one.x - one.y);
    last += vec4(-dot(last.yzw, axis), w * axis + cross(last.yzw, axis));
#endif
    vec3 scales = u_product ? log_sigmoid(first.yzw) + log_sigmoid(vec3(logit)) : log_sigmoid(first.yzw + logit);
    if (u_grows) scales += log(max(1.0, norm(own.xyz / u_half_extent)));
    vec4 quat = last + vec4(1.0, 0.0, 0.0, 0.0);
    quat /= max(length(quat), 1e-12);
    float opacity = 1.0 / (1.0 + exp(-first.x - own.w)), size = texelFetch(u_pixel_sizes, place, 0).x;
    vec3 mean = own.xyz;
#ifdef MOVED
    vec4 turn = u_place_quat, q = quat;
    mean = u_place_scale * (u_place_rows * mean) + u_place_shift;
    scales += log(u_place_scale);
    size *= u_place_scale;
    quat = vec4(
        turn.x * q.x - dot(turn.yzw, q.yzw), turn.x * q.yzw + q.x * turn.yzw + cross(turn.yzw, q.yzw)
    );
#endif
    scales = (scales + 22.0) / 44.0;
    o_place = uvec4(floatBitsToUint(mean), packUnorm2x16(vec2(opacity, scales.z)));
    o_shape = uvec4(packSnorm2x16(quat.xy), packSnorm2x16(quat.zw), packUnorm2x16(scales.xy), 0u);
    o_shape.w = floatBitsToUint(size);
}
