// The background all around: an equirectangular picture of its sphere, with the colours that an eye sees there.
uniform vec2 u_size; // of the picture
uniform vec3 u_eye;

out vec4 o_color;

void main() {
    float longitude = (2.0 * gl_FragCoord.x / u_size.x - 1.0) * PI, latitude = (0.5 - gl_FragCoord.y / u_size.y) * PI;
    vec3 d = vec3(cos(latitude) * sin(longitude), -sin(latitude), cos(latitude) * cos(longitude));
    vec3 place = RADIUS * d;
    o_color = vec4(background(place, normalize(place - u_eye)), 1.0);
}
