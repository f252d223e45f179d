#version 300 es
// A picture, made as large as the target.
precision highp float;
precision highp sampler2D;

uniform sampler2D u_picture;
uniform vec2 u_size; // of the target

out vec4 o_color;

void main() {
    o_color = texture(u_picture, gl_FragCoord.xy / u_size);
}
