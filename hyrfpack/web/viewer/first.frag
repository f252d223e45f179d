// The colour decoder's first layer as far as places decide it. As many cells of it as there are targets.
uniform usampler2D u_places;
uniform int u_first; // cell

EACH layout(location = $) out uvec4 o_cell$;

uvec4 halves(vec4 a, vec4 b) {
    const float MOST = 65504.0;
    a = clamp(a, -MOST, MOST);
    b = clamp(b, -MOST, MOST);
    return uvec4(packHalf2x16(a.xy), packHalf2x16(a.zw), packHalf2x16(b.xy), packHalf2x16(b.zw));
}

void main() {
    vec3 p = uintBitsToFloat(texelFetch(u_places, ivec2(gl_FragCoord.xy), 0).xyz);
    begin(BIAS_1 + 2 * u_first);
    add_place(p, INPUTS + 2 * u_first, 2 * ALL_CELLS);
EACH o_cell$ = halves(a$, b$);
}
