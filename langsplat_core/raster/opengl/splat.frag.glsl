// Steps 3 and 4 of raster/reference.py, back to front: premultiplied, blended with (1, 1 - alpha).
// Row 0 of the image is row 0 of the target, so gl_FragCoord is the pixel centre.

uniform float alpha_min;
uniform float alpha_max;

flat in vec2 mean;
flat in vec4 footprint;
flat in float opacity;
#if VALUES > 0
flat in vec3 value[VALUES];
layout(location = 0) out vec4 image[VALUES];
#endif
#if DEPTH
flat in float depth;
layout(location = VALUES) out vec4 depth_image;  // the target keeps two channels; blending needs the last
#endif

void main() {
    // Distances in standard deviations along the footprint's axes: a quadratic form of the inverse
    // covariance would cancel for long needles.
    vec2 d = gl_FragCoord.xy - mean;
    vec2 v = vec2(dot(footprint.xy, d), footprint.x * d.y - footprint.y * d.x) * footprint.zw;
    float alpha = min(alpha_max, opacity * exp(-0.5 * dot(v, v)));
    if (alpha < alpha_min)
        discard;
#if VALUES > 0
#define BLEND(i) image[i] = vec4(value[i] * alpha, alpha);
    EACH_VALUE(BLEND)
#endif
#if DEPTH
    depth_image = vec4(depth * alpha, alpha, 0.0, alpha);
#endif
}
