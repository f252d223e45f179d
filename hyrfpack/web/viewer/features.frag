// The hash features of each Gaussian as halves, 8 a layer. As many layers as there are targets.
#ifdef MOVED // places are those in the scene
uniform sampler2D u_explicit; // x, y, z; opacity logit
#define POSITION(place) texelFetch(u_explicit, place, 0).xyz
#else
uniform usampler2D u_places;
#define POSITION(place) uintBitsToFloat(texelFetch(u_places, place, 0).xyz)
#endif
uniform int u_first; // layer

EACH layout(location = $) out uvec4 o_layer$;

uvec4 four_levels(vec3 c, int first) {
    const float MOST = 65504.0;
    uvec4 packed = uvec4(0u);
    for (int k = 0; k < 4; ++k) {
        if (first + k < LEVELS) packed[k] = packHalf2x16(clamp(features(u_levels[first + k], c), -MOST, MOST));
    }
    return packed;
}

void main() {
    vec3 c = contract(POSITION(ivec2(gl_FragCoord.xy)));
EACH o_layer$ = four_levels(c, 4 * (u_first + $));
}
