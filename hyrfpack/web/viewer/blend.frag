#version 300 es
// A splat at a pixel, premultiplied.
precision highp float;

flat in vec2 v_mean;
flat in vec3 v_conic;
flat in vec4 v_color;

uniform float u_alpha_min;

out vec4 o_color;

void main() {
    vec2 d = v_mean - gl_FragCoord.xy;
    float power = min(0.0, -0.5 * (v_conic.x * d.x * d.x + v_conic.z * d.y * d.y) - v_conic.y * d.x * d.y);
    float alpha = min(0.99, v_color.a * exp(power));
    if (!(alpha >= u_alpha_min)) discard; // what overflowed is not drawn either
    o_color = vec4(v_color.rgb * alpha, alpha);
}
