#version 300 es
// The blended splats over the background, exposed.
precision highp float;
precision highp sampler2D; // else lowp, which phones take at its word

uniform sampler2D u_splats; // premultiplied, row 0 on top, one texel a pixel
uniform bool u_pictured; // the background is a picture, else a colour
uniform sampler2D u_background; // equirectangular, on a sphere
uniform sampler2D u_sky; // instead, between nodes whose alpha is 1, row 0 on top
uniform vec2 u_stride; // pixels of the target between its nodes; 0: do not use it
uniform float u_origin; // place of the target's corner in it, in texels
uniform vec3 u_from; // the eye in units of the sphere's radius, from its centre
uniform vec3 u_solid;
uniform vec3 u_gains; // of the exposure; 1 changes nothing
uniform sampler2D u_logs; // instead, blended log gains from -8 to 8 as 0 to 1, like u_splats
uniform vec4 u_log_behind; // that of the background; take these if alpha is 1
uniform mat3 u_world; // world from camera
uniform vec4 u_intrinsics; // fx, fy, cx, cy in pixels of the target

out vec4 o_color;

const float PI = 3.14159265358979;

// Along a ray: what the sphere shows where it ends.
vec3 background(vec3 ray) {
    float along = dot(u_from, ray);
    vec3 d = normalize(u_from + (sqrt(max(along * along - dot(u_from, u_from) + 1.0, 0.0)) - along) * ray);
    float longitude = atan(d.x, d.z), latitude = asin(clamp(-d.y, -1.0, 1.0));
    return texture(u_background, vec2(0.5 + longitude / (2.0 * PI), 0.5 - latitude / PI)).rgb;
}

void main() {
    vec2 pixel = gl_FragCoord.xy; // row 0 is on top
    vec4 splats = texelFetch(u_splats, ivec2(pixel), 0);
    vec3 behind = u_solid;
    vec4 sky = vec4(0.0);
    if (u_stride.x > 0.0) sky = texture(u_sky, (u_origin + pixel / u_stride) / vec2(textureSize(u_sky, 0)));
    if (sky.a > 0.99) behind = sky.rgb;
    else if (u_pictured) behind = background(normalize(u_world * vec3((pixel - u_intrinsics.zw) / u_intrinsics.xy, 1.0)));
    vec3 color = clamp(splats.rgb + (1.0 - splats.a) * behind, 0.0, 1.0);
    vec3 gains = u_gains;
    if (u_log_behind.a > 0.0) {
        vec4 logs = texelFetch(u_logs, ivec2(pixel), 0);
        gains = exp(16.0 * (logs.rgb + (1.0 - logs.a) * u_log_behind.rgb) - 8.0);
    }
    o_color = vec4(gains * color / (1.0 + (gains - 1.0) * color), 1.0);
}
