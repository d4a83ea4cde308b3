/** A picture of all directions, drawn as an eye in its middle sees it. */

import type { Camera } from '../core/site'

const VERTEX = `#version 300 es
in vec2 corner; out vec2 at;
void main() { at = corner; gl_Position = vec4(corner, 0.0, 1.0); }`

// Rows of `turn` are the view's right, down and ahead in camera axes (x right, y down, z ahead).
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 at; out vec4 drawn;
uniform sampler2D picture; uniform mat3 turn; uniform vec2 half_size, middle, scale;
void main() {
  vec3 d = turn * vec3(at.x * half_size.x, -at.y * half_size.y, 1.0);
  vec2 place = middle + scale * vec2(atan(d.x, d.z), atan(d.y, length(d.xz)));
  drawn = place.y < 0.0 || place.y > 1.0 ? vec4(0.0, 0.0, 0.0, 1.0) : texture(picture, place);
}`

export class Panorama {
  /** Radians: to the right and down from the picture's middle; and the angle of the view's height. */
  yaw = 0
  pitch = 0
  angle = 1.2
  readonly #gl: WebGL2RenderingContext
  readonly #program: WebGLProgram

  constructor(readonly canvas: HTMLCanvasElement) {
    const gl = canvas.getContext('webgl2', { preserveDrawingBuffer: true })
    if (!gl) throw new Error('this browser offers no WebGL 2, which pictures of 360° need')
    this.#gl = gl
    this.#program = gl.createProgram()!
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]] as const) {
      const shader = gl.createShader(kind)!
      gl.shaderSource(shader, text)
      gl.compileShader(shader)
      gl.attachShader(this.#program, shader)
    }
    gl.linkProgram(this.#program)
    gl.useProgram(this.#program)
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer())
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW)
    const corner = gl.getAttribLocation(this.#program, 'corner')
    gl.enableVertexAttribArray(corner)
    gl.vertexAttribPointer(corner, 2, gl.FLOAT, false, 0, 0)
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture())
    for (const [name, value] of [[gl.TEXTURE_WRAP_S, gl.REPEAT], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE], [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR]] as const) {
      gl.texParameteri(gl.TEXTURE_2D, name, value)
    }
  }

  /** Takes a picture, drawn smaller where the graphics hold none that large; and where it has longitude and latitude 0. */
  async load(picture: ImageBitmap, { width_px, height_px, focal_px, principal_px }: Camera): Promise<void> {
    const gl = this.#gl
    const shrunk = Math.min(1, (gl.getParameter(gl.MAX_TEXTURE_SIZE) as number) / Math.max(picture.width, picture.height))
    const size = { resizeWidth: Math.floor(picture.width * shrunk), resizeHeight: Math.floor(picture.height * shrunk) }
    const held = shrunk < 1 ? await createImageBitmap(picture, { ...size, resizeQuality: 'high' }) : picture
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, held)
    gl.uniform2f(gl.getUniformLocation(this.#program, 'middle'), (principal_px[0] + 0.5) / width_px, (principal_px[1] + 0.5) / height_px)
    gl.uniform2f(gl.getUniformLocation(this.#program, 'scale'), focal_px[0] / width_px, focal_px[1] / height_px)
  }

  /** Columns: the view's right, down and ahead in camera axes. */
  #turn(): number[] {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)]
    return [cy, 0, -sy, -sy * sp, cp, -cy * sp, sy * cp, sp, cy * cp]
  }

  #half(): [number, number] {
    const high = Math.tan(this.angle / 2)
    return [(high * this.canvas.width) / this.canvas.height, high]
  }

  draw(): void {
    const gl = this.#gl
    gl.viewport(0, 0, this.canvas.width, this.canvas.height)
    gl.uniformMatrix3fv(gl.getUniformLocation(this.#program, 'turn'), false, this.#turn())
    gl.uniform2f(gl.getUniformLocation(this.#program, 'half_size'), ...this.#half())
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4)
  }

  /** Longitude and latitude (radians, right and down of the picture's middle) below a point of the canvas (0 to 1). */
  directionAt(x: number, y: number): [number, number] {
    const [wide, high] = this.#half()
    const [vx, vy] = [(2 * x - 1) * wide, (2 * y - 1) * high]
    const m = this.#turn()
    const d = [0, 1, 2].map((row) => m[row]! * vx + m[row + 3]! * vy + m[row + 6]!) as [number, number, number]
    return [Math.atan2(d[0], d[2]), Math.asin(d[1] / Math.hypot(...d))]
  }

  /** The point of the canvas (0 to 1) at which a direction is seen; null where it is behind. */
  pointOf(longitude: number, latitude: number): [number, number] | null {
    const d = [Math.sin(longitude) * Math.cos(latitude), Math.sin(latitude), Math.cos(longitude) * Math.cos(latitude)] as const
    const m = this.#turn()
    const [x, y, z] = [0, 3, 6].map((column) => m[column]! * d[0] + m[column + 1]! * d[1] + m[column + 2]! * d[2]) as [number, number, number]
    if (z <= 0.01) return null
    const [wide, high] = this.#half()
    return [(x / z / wide + 1) / 2, (y / z / high + 1) / 2]
  }
}
