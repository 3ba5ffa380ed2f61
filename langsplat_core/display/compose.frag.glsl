// From channels to an image; composing.py beside it does the same on the CPU and a test compares the two.
// Channels are premultiplied by alpha, row 0 is the top row. HEAT_FADE, SEGMENT_OPACITY, LEAST_ALPHA,
// MAX_QUERIES, MAP_NODES and SHOWN, all drawings as one expression, are defined from displays.py.

uniform sampler2D colours;      // rgb, alpha
uniform sampler2D extra;        // latent colours, alpha; one query per channel (0: none), alpha; or
                                // sum of weight * camera z, alpha
uniform sampler2D colour_maps;  // MAP_NODES x maps
uniform int colour_map;         // row of the one in use
uniform vec3 query_colours[MAX_QUERIES];

uniform int display;            // number of its drawing
uniform vec2 ranges[MAX_QUERIES];  // per component of the further channel, the values drawn as 0 and as 1
uniform bool own_colours;       // heat in the colour of each query instead of the colour map
uniform float heat_opacity;
uniform float dim;
uniform float threshold;
uniform float alpha_gate;
uniform vec3 background;
uniform bool transparent;       // no background, alpha as a fourth channel, colours not premultiplied

in vec2 uv;
out vec4 picture;

vec3 mapped(float t) {
    float position = clamp(t, 0.0, 1.0) * float(MAP_NODES - 1);
    int low = min(int(position), MAP_NODES - 2);
    // Two fetches, not a filtered lookup: filters round the fraction to 8 bits.
    return mix(texelFetch(colour_maps, ivec2(low, colour_map), 0).rgb,
               texelFetch(colour_maps, ivec2(low + 1, colour_map), 0).rgb, position - float(low));
}

vec3 heat_map(vec3 base, vec3 relevancy) {
    float heat = 0.0;
    float total = 0.0;
    vec3 mean = vec3(0.0);
    for (int j = 0; j < MAX_QUERIES; ++j) {
        vec2 range = ranges[j];
        float own = clamp((relevancy[j] - range.x) / (range.y - range.x), 0.0, 1.0);
        heat = max(heat, own);
        total += own;
        mean += own * query_colours[j];
    }
    vec3 hot = own_colours ? mean / max(total, 1e-9) : mapped(heat);
    return mix(base * dim, hot, heat_opacity * smoothstep(0.0, own_colours ? 1.0 : HEAT_FADE, heat));
}

vec3 segments(vec3 base, vec3 relevancy) {
    int winner = 0;
    for (int j = 1; j < MAX_QUERIES; ++j)
        if (relevancy[j] > relevancy[winner])
            winner = j;
    bool inside = relevancy[winner] > threshold;
    vec2 range = ranges[winner];
    float opacity = SEGMENT_OPACITY * clamp((1.0 - range.x) / (range.y - range.x), 0.0, 1.0);
    return inside ? mix(base, query_colours[winner], opacity) : base * dim;
}

vec4 depth_map(vec2 sums) {
    vec2 range = ranges[0];
    float t = (sums.r / max(sums.g, 1e-9) - range.x) / max(range.y - range.x, 1e-9);
    vec3 backdrop = transparent ? vec3(0.0) : background;
    return sums.g > alpha_gate ? vec4(mapped(1.0 - clamp(t, 0.0, 1.0)), 1.0) : vec4(backdrop, 0.0);
}

void main() {
    vec2 place = vec2(uv.x, 1.0 - uv.y);
    vec4 c = texture(colours, place);
    vec4 sums = texture(extra, place);
    vec3 uncovered = transparent ? vec3(0.0) : (1.0 - c.a) * background;
    float share = transparent ? max(c.a, LEAST_ALPHA) : 1.0;
    vec3 base = clamp(c.rgb / share + uncovered, 0.0, 1.0);
    vec3 mean = sums.a > alpha_gate ? sums.rgb / sums.a : vec3(0.0);
    vec4 shown = SHOWN;
    picture = vec4(clamp(shown.rgb, 0.0, 1.0), transparent ? shown.a : 1.0);
}
