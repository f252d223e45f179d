// The shaders of `hyrf-object.js`. Lengths are in the model's local units, the camera has OpenCV's axes, and pixels
// count from the top left corner.

export const GAUSSIANS_PER_ROW = 2048; // of the textures, as the worker delivers them

const VIEW = `
uniform mat3 u_rotation; // camera from local
uniform vec3 u_translation;
uniform vec4 u_intrinsics; // fx, fy, cx, cy in pixels
uniform vec2 u_size; // of the picture in pixels
`;

// Applies the gains of an exposure to a displayed colour, of which what exceeds 1 is white. Gains of 1 change nothing.
const EXPOSE = `
vec3 expose(vec3 color, vec3 gains) {
    if (gains == vec3(1.0)) return color;
    color = clamp(color, 0.0, 1.0);
    return gains * color / (1.0 + (gains - 1.0) * color);
}
`;

// Projects a Gaussian as hyrfpack/ops/rasterize/reference.py does, and spans a quad where its alpha is at least 1/255.
export const gaussianVertex = `
#include <common>
#include <logdepthbuf_pars_vertex>
${VIEW}
${EXPOSE}
uniform highp usampler2D u_order; // indices of Gaussians, farthest first
uniform sampler2D u_shapes; // three texels a Gaussian: position, three axes
uniform sampler2D u_colors; // red, green, blue, opacity
uniform sampler2D u_pixel_sizes; // of the photos, of four Gaussians a texel
uniform sampler2D u_row_gains; // of the exposure of each row of Gaussians
uniform int u_drawn; // the number of valid indices
uniform int u_quads; // of an instance
uniform bool u_antialiased;
uniform float u_near;
uniform float u_margin; // where centres may lie outside the picture, as a part of half its size
uniform vec3 u_depth; // the depth's row of the projection matrix (2 numbers), and the size of a local unit

flat varying vec2 v_mean;
flat varying vec3 v_conic;
flat varying vec4 v_color;

const int WIDTH = ${GAUSSIANS_PER_ROW};
const float LOW_PASS = 0.3; // px^2
const float SAMPLING_VARIANCE = 0.4; // px^2 of the photos
const float COMPENSATION_MIN = 2.5e-5;
const float SLACK = 0.1; // px, because quads are snapped to a fraction of a pixel

vec4 shapeTexel(int index) {
    return texelFetch(u_shapes, ivec2(index % WIDTH, index / WIDTH), 0);
}

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside
    v_mean = vec2(0.0);
    v_conic = vec3(0.0);
    v_color = vec4(0.0);
    int turn = gl_InstanceID * u_quads + gl_VertexID / 4;
    if (turn >= u_drawn) return;
    int splat = int(texelFetch(u_order, ivec2(turn % WIDTH, turn / WIDTH), 0).x);
    vec4 color = texelFetch(u_colors, ivec2(splat % WIDTH, splat / WIDTH), 0);
    if (color.a * 255.0 < 1.0) return; // not evaluated yet, or invisible

    vec4 one = shapeTexel(3 * splat), two = shapeTexel(3 * splat + 1), three = shapeTexel(3 * splat + 2);
    vec3 p = u_rotation * one.xyz + u_translation;
    vec2 focal = u_intrinsics.xy, principal = u_intrinsics.zw, margin = 0.5 * u_margin * u_size;
    bool isInside = p.z > u_near
        && all(greaterThan(focal * p.xy, (-margin - principal) * p.z))
        && all(lessThan(focal * p.xy, (u_size + margin - principal) * p.z));
    if (!isInside) return;

    mat3 axes = mat3(one.w, two.xyz, two.w, three.x, three.yzw);
    float size = texelFetch(u_pixel_sizes, ivec2(splat % WIDTH / 4, splat / WIDTH), 0)[splat % 4];
    float own = p.z / max(focal.x, focal.y), added = SAMPLING_VARIANCE * (size * size - own * own);
    if (added > 0.0) { // no detail is finer than the photos' pixels
        vec3 squares = max(vec3(dot(axes[0], axes[0]), dot(axes[1], axes[1]), dot(axes[2], axes[2])), 1e-30);
        vec3 kept = squares / (squares + added), factors = inversesqrt(kept);
        // Of the two longest axes.
        if (u_antialiased) color.a *= sqrt(max(kept.x * kept.y, max(kept.y * kept.z, kept.z * kept.x)));
        for (int axis = 0; axis < 3; ++axis) axes[axis] *= factors[axis];
    }

    vec2 slope = p.xy / p.z, slack = 0.15 * u_size / focal;
    vec2 clamped = clamp(slope, -principal / focal - slack, (u_size - principal) / focal + slack);
    mat3 rows = transpose(u_rotation * axes);
    vec3 first = focal.x / p.z * (rows[0] - clamped.x * rows[2]);
    vec3 second = focal.y / p.z * (rows[1] - clamped.y * rows[2]);
    float xx = dot(first, first), xy = dot(first, second), yy = dot(second, second);
    vec3 normal = cross(first, second); // free of the cancellation in xx yy - xy^2
    float determinant = dot(normal, normal);
    float filtered = determinant + LOW_PASS * (xx + yy + LOW_PASS);
    xx += LOW_PASS;
    yy += LOW_PASS;
    if (u_antialiased) color.a *= sqrt(max(determinant / filtered, COMPENSATION_MIN));
    if (color.a * 255.0 < 1.0) return;

    v_mean = focal * slope + principal;
    v_conic = vec3(yy, -xy, xx) / filtered;
    v_color = vec4(expose(color.rgb, texelFetch(u_row_gains, ivec2(0, splat / WIDTH), 0).rgb), color.a);
    float larger = 0.5 * (xx + yy) + length(vec2(0.5 * (xx - yy), xy));
    vec2 axis = xx > yy ? vec2(larger - yy, xy) : vec2(xy, larger - xx);
    axis = dot(axis, axis) > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
    float reach = 2.0 * log(255.0 * color.a);
    vec2 extent = sqrt(reach * vec2(larger, filtered / larger)) + SLACK;
    extent = min(extent, 1.5 * (u_size.x + u_size.y)); // centres are near the picture: this covers it
    vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
    vec2 pixel = v_mean + corner.x * extent.x * axis + corner.y * extent.y * vec2(-axis.y, axis.x);
    float distance = u_depth.z * p.z;
    vec2 place = vec2(2.0, -2.0) * pixel / u_size + vec2(-1.0, 1.0);
    gl_Position = vec4(place * distance, u_depth.y - u_depth.x * distance, distance);
    #include <logdepthbuf_vertex>
}
`;

export const gaussianFragment = `
#include <logdepthbuf_pars_fragment>
uniform vec2 u_size;

flat varying vec2 v_mean;
flat varying vec3 v_conic;
flat varying vec4 v_color;

void main() {
    #include <logdepthbuf_fragment>
    vec2 d = v_mean - vec2(gl_FragCoord.x, u_size.y - gl_FragCoord.y);
    float power = min(0.0, -0.5 * (v_conic.x * d.x * d.x + v_conic.z * d.y * d.y) - v_conic.y * d.x * d.y);
    float alpha = min(0.99, v_color.a * exp(power));
    if (!(alpha >= 1.0 / 255.0)) discard; // true for NaN, too
    gl_FragColor = vec4(v_color.rgb * alpha, alpha);
}
`;

const EXPOSURE = `
uniform vec3 u_gains;
${EXPOSE}
`;

// Looks the background up by the point of its sphere that a pixel sees.
const SKY = `
uniform sampler2D u_coarse_sky, u_fine_sky; // equirectangular; the fine one has alpha 0 where it is not evaluated yet
uniform vec3 u_eye; // in units of the sphere's radius

vec3 sky(vec2 pixel) {
    vec2 slope = (vec2(pixel.x, u_size.y - pixel.y) - u_intrinsics.zw) / u_intrinsics.xy;
    vec3 ray = normalize(vec3(slope, 1.0) * u_rotation);
    float along = dot(u_eye, ray);
    vec3 d = normalize(u_eye + (sqrt(max(along * along - dot(u_eye, u_eye) + 1.0, 0.0)) - along) * ray);
    vec2 place = vec2(0.5 + atan(d.x, d.z) / 6.283185307179586, 0.5 + asin(clamp(d.y, -1.0, 1.0)) / 3.141592653589793);
    vec4 fine = texture2D(u_fine_sky, place);
    return fine.rgb + (1.0 - fine.a) * texture2D(u_coarse_sky, place).rgb;
}
`;

// A triangle that covers the picture.
export const wholeVertex = `
void main() {
    gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 4.0 * float(gl_VertexID >> 1) - 1.0, 0.0, 1.0);
}
`;

// The file's colours are those of sRGB, as displayed. three.js converts them from its linear working space.
const OUTPUT = `
    gl_FragColor = sRGBTransferEOTF(gl_FragColor);
    #include <colorspace_fragment>
    #include <premultiplied_alpha_fragment>
`;

// Gains apply to the sum of Gaussians and background. So with gains, the colour is what the background, which has its
// gains already, lacks of that sum. It is exact where no mesh is behind the Gaussians.
export const compositeFragment = `
${VIEW}
${EXPOSURE}
${SKY}
uniform sampler2D u_blended; // premultiplied
uniform vec2 u_corner; // the lower left corner of the viewport in pixels
uniform bool u_has_sky;

void main() {
    vec2 pixel = gl_FragCoord.xy - u_corner;
    vec4 blended = texelFetch(u_blended, ivec2(pixel), 0);
    if (blended.a <= 0.0) discard;
    vec3 color = blended.rgb / blended.a;
    if (u_gains != vec3(1.0)) {
        vec3 behind = u_has_sky ? sky(pixel) : color;
        float passed = 1.0 - blended.a;
        color = (expose(blended.rgb + passed * behind, u_gains) - passed * expose(behind, u_gains)) / blended.a;
    }
    gl_FragColor = vec4(clamp(color, 0.0, 1.0), blended.a);
    ${OUTPUT}
}
`;

export const skyFragment = `
${VIEW}
${EXPOSURE}
${SKY}
uniform vec2 u_corner;

void main() {
    gl_FragColor = vec4(expose(sky(gl_FragCoord.xy - u_corner), u_gains), 1.0);
    ${OUTPUT}
}
`;
