// One triangle that covers the viewport; needs no vertex buffer.

out vec2 uv;  // (0, 0) bottom left to (1, 1) top right of the viewport

void main() {
    uv = vec2((gl_VertexID & 1) << 1, gl_VertexID & 2);
    gl_Position = vec4(2.0 * uv - 1.0, 0.0, 1.0);
}
