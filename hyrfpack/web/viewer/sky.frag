// The background at nodes of a grid, which are pixel centres, where it is needed; elsewhere black. Alpha is 1.
uniform sampler2D u_needed; // from needed.frag
uniform float u_stride; // of the nodes in pixels
uniform vec3 u_eye;
uniform mat3 u_world; // world from camera
uniform vec4 u_intrinsics; // fx, fy, cx, cy in pixels

out vec4 o_color;

void main() {
    o_color = vec4(0.0, 0.0, 0.0, 1.0);
    if (texelFetch(u_needed, ivec2(gl_FragCoord.xy), 0).x == 0.0) return;
    vec2 pixel = u_stride * (gl_FragCoord.xy - 0.5) + 0.5;
    vec3 ray = normalize(u_world * vec3((pixel - u_intrinsics.zw) / u_intrinsics.xy, 1.0));
    vec3 from = u_eye / RADIUS;
    float along = dot(from, ray);
    vec3 place = from + (sqrt(max(along * along - dot(from, from) + 1.0, 0.0)) - along) * ray;
    o_color = vec4(background(RADIUS * place, ray), 1.0);
}
