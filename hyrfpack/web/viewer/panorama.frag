// The background all around, seen from the middle of its sphere: an equirectangular picture.
uniform vec2 u_size; // of the picture

out vec4 o_color;

const float RADIUS = 100.0; // local units

void main() {
    float longitude = (2.0 * gl_FragCoord.x / u_size.x - 1.0) * PI, latitude = (0.5 - gl_FragCoord.y / u_size.y) * PI;
    vec3 d = vec3(cos(latitude) * sin(longitude), -sin(latitude), cos(latitude) * cos(longitude));
    begin(BIAS_1);
    add_place(RADIUS * d, INPUTS, 2 * CELLS);
    add_direction(d);
    rectify();
    vec4 sum = WEIGHT(BIAS_3);
    for (int group = 0; group < 2 * CELLS; ++group) sum += MATRIX(MATRIX_3 + 4 * group) * second(group);
    o_color = vec4(sigmoid(sum.xyz), 1.0);
}
