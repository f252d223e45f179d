#version 300 es
// Where splats let the background through: 1, elsewhere 0.
precision highp float;
precision highp sampler2D;

uniform sampler2D u_splats; // as resolve.frag has them
uniform vec2 u_used;
uniform vec2 u_size; // of the target

out vec4 o_needed;

const float THRESHOLD = 1.0 / 512.0; // of the light that passes, as in hyrfpack render

void main() {
    vec2 texel = clamp(gl_FragCoord.xy / u_size * u_used, vec2(0.5), u_used - 0.5);
    o_needed = vec4(1.0 - texture(u_splats, texel / vec2(textureSize(u_splats, 0))).a > THRESHOLD ? 1.0 : 0.0);
}
