/** Lines, marks and labels over the cloud, drawn as crisp as text. */

import { type Camera, Matrix4, Vector4 } from 'three'

export interface Drawing {
  kind: 'line' | 'cross' | 'ring' | 'area'
  points: [number, number, number][]
  label?: string
  dots?: boolean
  colour?: string
}

export function drawOverlay(
  canvas: HTMLCanvasElement,
  size: { width: number; height: number },
  camera: Camera,
  origin: readonly number[],
  drawings: Drawing[],
  dark: boolean,
): void {
  const context = canvas.getContext('2d')!
  const ratio = canvas.width / size.width
  context.setTransform(ratio, 0, 0, ratio, 0, 0)
  context.clearRect(0, 0, size.width, size.height)
  const seen = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse)
  const project = (point: readonly number[]): Vector4 =>
    new Vector4(point[0]! - origin[0]!, point[1]! - origin[1]!, point[2]! - origin[2]!, 1).applyMatrix4(seen)
  const pixel = (at: Vector4): [number, number] => [((at.x / at.w + 1) / 2) * size.width, ((1 - at.y / at.w) / 2) * size.height]
  const accent = dark ? '#ffd43b' : '#c2255c'
  for (const drawing of drawings) {
    const colour = drawing.colour ?? accent
    if (drawing.kind === 'line' || drawing.kind === 'area') stroke(context, drawing, project, pixel, colour, dark)
    const dots = drawing.kind === 'line' ? (drawing.dots ? drawing.points : []) : drawing.kind === 'area' ? [] : drawing.points
    for (const point of dots) {
      const at = project(point)
      if (at.w <= 0.01) continue
      mark(context, pixel(at), drawing.kind === 'line' ? 'dot' : drawing.kind, colour, dark)
    }
    if (drawing.label) letter(context, drawing, project, pixel, dark)
  }
}

type Project = (point: readonly number[]) => Vector4
type Pixel = (at: Vector4) => [number, number]

/** A line, cut where it passes behind the eye. */
function stroke(context: CanvasRenderingContext2D, drawing: Drawing, project: Project, pixel: Pixel, colour: string, dark: boolean): void {
  const points = drawing.kind === 'area' ? [...drawing.points, drawing.points[0]!] : drawing.points
  const near = 0.02
  context.beginPath()
  for (let index = 1; index < points.length; index++) {
    let [a, b] = [project(points[index - 1]!), project(points[index]!)]
    if (a.w < near && b.w < near) continue
    if (a.w < near) a = b.clone().lerp(a, (b.w - near) / (b.w - a.w))
    if (b.w < near) b = a.clone().lerp(b, (a.w - near) / (a.w - b.w))
    context.moveTo(...pixel(a))
    context.lineTo(...pixel(b))
  }
  context.lineJoin = 'round'
  context.strokeStyle = dark ? 'rgba(0,0,0,.8)' : 'rgba(255,255,255,.9)'
  context.lineWidth = 4.5
  context.stroke()
  context.strokeStyle = colour
  context.lineWidth = 2
  context.stroke()
}

function mark(context: CanvasRenderingContext2D, [x, y]: [number, number], kind: 'dot' | 'cross' | 'ring' | 'area', colour: string, dark: boolean): void {
  for (const [width, style] of [[4.5, dark ? '#000' : '#fff'], [2, colour]] as const) {
    context.beginPath()
    if (kind === 'cross') {
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]] as const) {
        context.moveTo(x + dx * 5, y + dy * 5)
        context.lineTo(x + dx * 15, y + dy * 15)
      }
    } else context.arc(x, y, kind === 'dot' ? 3.5 : 8, 0, 2 * Math.PI)
    context.strokeStyle = style
    context.lineWidth = width
    context.stroke()
  }
}

function letter(context: CanvasRenderingContext2D, drawing: Drawing, project: Project, pixel: Pixel, dark: boolean): void {
  const middle = drawing.points[Math.floor(drawing.points.length / 2)]!
  const before = drawing.points[Math.max(0, Math.ceil(drawing.points.length / 2) - 1)]!
  const at = project([0, 1, 2].map((axis) => (middle[axis]! + before[axis]!) / 2))
  if (at.w <= 0.01) return
  const [x, y] = pixel(at)
  context.font = '600 12px system-ui, sans-serif'
  context.textAlign = 'center'
  const width = context.measureText(drawing.label!).width
  context.fillStyle = dark ? 'rgba(16,18,22,.9)' : 'rgba(255,255,255,.94)'
  context.beginPath()
  context.roundRect(x - width / 2 - 6, y - 25, width + 12, 18, 4)
  context.fill()
  context.fillStyle = dark ? '#f1f3f5' : '#1b1f24'
  context.fillText(drawing.label!, x, y - 12)
}
