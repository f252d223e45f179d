#version 300 es
// A splat's quad: as far as its alpha is at least u_alpha_min, along the axes of its ellipse. Row 0 of the target is on
// top.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D u_order; // of splats, farthest first
uniform int u_drawn; // how many of it count
uniform int u_quads; // an instance
uniform usampler2D u_shapes; // from project.frag
uniform usampler2D u_projected; // likewise
uniform vec2 u_size;
uniform float u_alpha_min;

flat out vec2 v_mean;
flat out vec3 v_conic;
flat out vec4 v_color; // opacity last

const float SLACK = 0.1; // pixels: quads are snapped to a fraction of a pixel

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside
    v_color = vec4(0.0);
    v_mean = vec2(0.0);
    v_conic = vec3(0.0);
    int turn = gl_InstanceID * u_quads + gl_VertexID / 4;
    if (turn >= u_drawn) return;
    int width = textureSize(u_shapes, 0).x;
    int splat = int(texelFetch(u_order, ivec2(turn % width, turn / width), 0).x);
    ivec2 place = ivec2(splat % width, splat / width);
    uvec4 look = texelFetch(u_projected, place, 0);
    v_color = vec4(unpackHalf2x16(look.z), unpackHalf2x16(look.w));
    if (v_color.a < u_alpha_min) return;

    vec4 shape = uintBitsToFloat(texelFetch(u_shapes, place, 0));
    float xx = shape.z, xy = shape.w, yy = uintBitsToFloat(look.x), determinant = uintBitsToFloat(look.y);
    v_mean = shape.xy;
    v_conic = vec3(yy, -xy, xx) / determinant;

    float larger = 0.5 * (xx + yy) + length(vec2(0.5 * (xx - yy), xy));
    vec2 axis = xx > yy ? vec2(larger - yy, xy) : vec2(xy, larger - xx);
    axis = dot(axis, axis) > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
    float reach = 2.0 * log(v_color.a / u_alpha_min);
    vec2 extent = sqrt(reach * vec2(larger, determinant / larger)) + SLACK;
    extent = min(extent, 1.5 * (u_size.x + u_size.y)); // centres are near the picture: this covers it
    vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
    vec2 pixel = v_mean + corner.x * extent.x * axis + corner.y * extent.y * vec2(-axis.y, axis.x);
    gl_Position = vec4(2.0 * pixel / u_size - 1.0, 0.0, 1.0);
}
