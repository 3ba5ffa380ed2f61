// From channels to a picture; langsplat_core/query/picture.py is the plain twin of this file and a test
// compares the two. Channels are premultiplied by alpha, row 0 is the top row.

uniform sampler2D colours;      // rgb, alpha
uniform sampler2D extra;        // latent colours, alpha; one query per channel (0: none), alpha; or
                                // sum of weight * camera z, alpha
uniform sampler2D turbo_table;  // 256 x 1
uniform vec3 query_colours[3];

uniform int display;            // 0 rgb, 1 latent, 2 relevancy, 3 segmentation, 4 depth, 5 alpha
uniform vec3 heat_spans;        // relevancy above the floor at which the heat saturates, per query
uniform float relevancy_floor;
uniform float heat_fade;
uniform float heat_opacity;
uniform float dim;
uniform float threshold;
uniform float segment_opacity;
uniform float alpha_gate;
uniform vec3 background;
uniform vec2 depth_range;       // world units

in vec2 uv;
out vec4 picture;

vec3 turbo(float t) {
    float position = clamp(t, 0.0, 1.0) * 255.0;
    int low = min(int(position), 254);
    // Two fetches, not a filtered lookup: filters round the fraction to 8 bits.
    return mix(texelFetch(turbo_table, ivec2(low, 0), 0).rgb,
               texelFetch(turbo_table, ivec2(low + 1, 0), 0).rgb, position - float(low));
}

void main() {
    vec2 place = vec2(uv.x, 1.0 - uv.y);
    vec4 c = texture(colours, place);
    vec3 uncovered = (1.0 - c.a) * background;
    vec3 base = clamp(c.rgb + uncovered, 0.0, 1.0);
    vec3 shown = base;
    if (display == 1) {
        shown = texture(extra, place).rgb + uncovered;
    } else if (display == 2 || display == 3) {
        vec4 sums = texture(extra, place);
        vec3 relevancy = sums.a > alpha_gate ? sums.rgb / sums.a : vec3(0.0);
        float highest = relevancy[0];
        int winner = 0;
        float heat = (relevancy[0] - relevancy_floor) / heat_spans[0];
        for (int j = 1; j < 3; ++j) {
            if (relevancy[j] > highest) {
                highest = relevancy[j];
                winner = j;
            }
            heat = max(heat, (relevancy[j] - relevancy_floor) / heat_spans[j]);
        }
        heat = clamp(heat, 0.0, 1.0);
        if (display == 2)
            shown = mix(base * dim, turbo(heat), heat_opacity * smoothstep(0.0, heat_fade, heat));
        else
            shown = highest > threshold ? mix(base, query_colours[winner], segment_opacity) : base * dim;
    } else if (display == 4) {
        vec2 sums = texture(extra, place).rg;
        float t = (sums.r / max(sums.g, 1e-9) - depth_range.x) / max(depth_range.y - depth_range.x, 1e-9);
        shown = sums.g > alpha_gate ? turbo(1.0 - clamp(t, 0.0, 1.0)) : background;
    } else if (display == 5) {
        shown = vec3(c.a);
    }
    picture = vec4(clamp(shown, 0.0, 1.0), 1.0);
}
