#version 300 es
// Projects splats to the picture, one splat a fragment: the mathematics of hyrfpack/ops/rasterize/reference.py.
// Splats are as pack.js and geometry.frag pack them.
precision highp float;
precision highp int;
precision highp usampler2D;
precision highp usampler2DArray;

uniform usampler2D u_places; // x, y, z as float32; opacity and log scale z
// Quaternion w, x; y, z; log scales x, y. Then splats have red, green, blue in 11, 11 and 10 bits, and Gaussians of a
// model the pixel size q of its photos as float32.
uniform usampler2D u_shapes;
uniform usampler2DArray u_harmonics; // bytes, 16 a layer: coefficient after coefficient, red, green, blue of each
uniform int u_degree;
uniform float u_range; // of coefficients
uniform usampler2D u_colors; // instead: halves red, green; blue, from colors.frag
uniform bool u_colored; // take these: the Gaussians are those of a model
uniform float u_focal; // max(fx, fy) of the picture at full resolution
uniform int u_count;
uniform bool u_antialiased;
// Variances in px^2 along x and y: of the picture at full resolution, and with the mean over its blocks.
uniform vec4 u_low_pass;
uniform mat3 u_rotation; // camera from page
uniform vec3 u_translation;
uniform vec3 u_eye;
uniform vec4 u_intrinsics; // fx, fy, cx, cy in pixels
uniform vec2 u_size;
uniform float u_near;
uniform float u_tolerance; // band around the picture in which centres may lie, as a fraction of half its size
uniform float u_pick; // > 0: instead of a colour, z / (z + u_pick)
uniform bool u_flat; // instead, the colour of each part
uniform vec3 u_flats[64];
uniform int u_first_row; // of the target
// Of each row of splats: its weight in [0, 1], while levels of detail fade; the number of its part.
uniform highp sampler2D u_weights;
uniform bool u_weighted; // take these

layout(location = 0) out uvec4 o_shape; // centre x, y in pixels; covariance xx, xy
layout(location = 1) out uvec4 o_look; // covariance yy; its determinant; halves red, green; halves blue, opacity

const float COMPENSATION_MIN = 2.5e-5;
const float SAMPLING_VARIANCE = 0.4; // px^2 of the photos

float byte_of(uint word, int place) {
    return float((word >> (8 * place)) & 255u);
}

mat3 rotation(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    );
}

uint words[12];

vec3 coefficient(int k) {
    int i = 3 * k;
    vec3 bytes = vec3(
        byte_of(words[i >> 2], i & 3), byte_of(words[(i + 1) >> 2], (i + 1) & 3), byte_of(words[(i + 2) >> 2], (i + 2) & 3)
    );
    return (bytes - 128.0) / 128.0 * u_range;
}

// Bands 1 to 3 with the Condon-Shortley phase, m = -l ... l.
vec3 harmonics(ivec2 place, vec3 d) {
    for (int layer = 0; layer < u_degree; ++layer) {
        uvec4 texel = texelFetch(u_harmonics, ivec3(place, layer), 0);
        for (int i = 0; i < 4; ++i) words[4 * layer + i] = texel[i];
    }
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    vec3 sum = 0.4886025119029199 * (-y * coefficient(0) + z * coefficient(1) - x * coefficient(2));
    if (u_degree > 1) {
        sum += 1.0925484305920792 * (x * y * coefficient(3) - y * z * coefficient(4) - x * z * coefficient(6));
        sum += 0.31539156525252005 * (3.0 * zz - 1.0) * coefficient(5);
        sum += 0.5462742152960396 * (xx - yy) * coefficient(7);
    }
    if (u_degree > 2) {
        sum -= 0.5900435899266435 * y * (3.0 * xx - yy) * coefficient(8);
        sum += 2.890611442640554 * x * y * z * coefficient(9);
        sum -= 0.4570457994644658 * (5.0 * zz - 1.0) * (y * coefficient(10) + x * coefficient(12));
        sum += 0.3731763325901154 * z * (5.0 * zz - 3.0) * coefficient(11);
        sum += 1.445305721320277 * z * (xx - yy) * coefficient(13);
        sum -= 0.5900435899266435 * x * (xx - 3.0 * yy) * coefficient(14);
    }
    return sum;
}

void main() {
    o_shape = uvec4(0u);
    o_look = uvec4(0u); // opacity 0: not drawn
    ivec2 place = ivec2(gl_FragCoord.xy) - ivec2(0, u_first_row);
    if (place.y * textureSize(u_places, 0).x + place.x >= u_count) return;

    uvec4 packed = texelFetch(u_places, place, 0);
    vec3 mean = uintBitsToFloat(packed.xyz);
    vec3 p = u_rotation * mean + u_translation;
    vec2 focal = u_intrinsics.xy, principal = u_intrinsics.zw;
    vec2 margin = 0.5 * u_tolerance * u_size;
    bool inside = p.z > u_near
        && all(greaterThan(focal * p.xy, (-margin - principal) * p.z))
        && all(lessThan(focal * p.xy, (u_size + margin - principal) * p.z));
    if (!inside) return;

    uvec4 shape = texelFetch(u_shapes, place, 0);
    vec2 last = unpackUnorm2x16(packed.w);
    float opacity = last.x;
    vec2 row = u_weighted ? texelFetch(u_weights, ivec2(0, place.y), 0).xy : vec2(1.0, 0.0);
    float weight = row.x;
    if (weight <= 0.0) return;
    // Equal opacities whose weights add up to 1 let as much light through as one of them.
    if (weight < 1.0) opacity = 1.0 - pow(max(1.0 - opacity, 1e-6), weight);
    vec3 scales = exp(vec3(unpackUnorm2x16(shape.z), last.y) * 44.0 - 22.0);
    vec4 quat = vec4(unpackSnorm2x16(shape.x), unpackSnorm2x16(shape.y));
    quat /= max(length(quat), 1e-12);

    if (u_colored) { // no detail is finer than the photos' pixels
        float size = uintBitsToFloat(shape.w), own = p.z / u_focal;
        float added = SAMPLING_VARIANCE * (size * size - own * own);
        if (added > 0.0) {
            vec3 squares = scales * scales, kept = squares / (squares + added);
            // Of the two longest axes.
            if (u_antialiased) opacity *= sqrt(max(kept.x * kept.y, max(kept.y * kept.z, kept.z * kept.x)));
            scales = sqrt(squares + added);
        }
    }

    vec2 slope = p.xy / p.z;
    vec2 slack = 0.15 * u_size / focal;
    vec2 clamped = clamp(slope, -principal / focal - slack, (u_size - principal) / focal + slack);
    mat3 axes = u_rotation * rotation(quat);
    mat3 rows = transpose(mat3(axes[0] * scales.x, axes[1] * scales.y, axes[2] * scales.z));
    vec3 first = focal.x / p.z * (rows[0] - clamped.x * rows[2]);
    vec3 second = focal.y / p.z * (rows[1] - clamped.y * rows[2]);

    float xx = dot(first, first), xy = dot(first, second), yy = dot(second, second);
    vec3 normal = cross(first, second); // free of the cancellation in xx yy - xy^2
    float determinant = dot(normal, normal);
    vec2 filtered = determinant + u_low_pass.xz * yy + u_low_pass.yw * xx + u_low_pass.xz * u_low_pass.yw;
    opacity *= sqrt(filtered.x / filtered.y); // 1 at full resolution
    if (u_antialiased) opacity *= sqrt(max(determinant / filtered.x, COMPENSATION_MIN));

    vec3 color;
    if (u_colored) {
        uvec2 halves = texelFetch(u_colors, place, 0).xy;
        color = vec3(unpackHalf2x16(halves.x), unpackHalf2x16(halves.y).x);
    } else {
        uvec3 levels = uvec3(shape.w, shape.w >> 11, shape.w >> 22) & uvec3(2047u, 2047u, 1023u);
        color = vec3(levels) * 3.0 / vec3(2047.0, 2047.0, 1023.0) - 1.0;
        if (u_degree > 0) color += harmonics(place, normalize(mean - u_eye));
    }
    if (u_flat) color = u_flats[int(row.y)];
    color = u_pick > 0.0 ? vec3(p.z / (p.z + u_pick)) : clamp(color, 0.0, 100.0); // far below what halves hold

    o_shape = uvec4(floatBitsToUint(focal * slope + principal), floatBitsToUint(vec2(xx + u_low_pass.z, xy)));
    o_look = uvec4(
        floatBitsToUint(vec2(yy + u_low_pass.w, filtered.y)), packHalf2x16(color.rg), packHalf2x16(vec2(color.b, opacity))
    );
}
