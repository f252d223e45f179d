#version 300 es
// Whether a node of the background is needed, 1 or 0: splats let the background through at a pixel that is interpolated
// from it.
precision highp float;
precision highp int;
precision highp sampler2D;

uniform sampler2D u_splats; // as resolve.frag has them, one texel a pixel
uniform ivec2 u_last; // the last pixel
uniform int u_stride; // of the nodes in pixels

out vec4 o_needed;

const float THRESHOLD = 1.0 / 512.0; // of the light that passes, as in hyrfpack render

void main() {
    ivec2 node = u_stride * ivec2(gl_FragCoord.xy);
    ivec2 first = max(node - u_stride + 1, 0), last = min(node + u_stride - 1, u_last);
    float least = 1.0;
    for (int y = first.y; y <= last.y; ++y) {
        for (int x = first.x; x <= last.x; ++x) least = min(least, texelFetch(u_splats, ivec2(x, y), 0).a);
    }
    o_needed = vec4(1.0 - least > THRESHOLD ? 1.0 : 0.0);
}
