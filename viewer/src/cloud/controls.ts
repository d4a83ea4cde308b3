/** Mouse, fingers and keys that move the eye. The place below the pointer stays below it. */

import { Vector3 } from 'three'
import type { Eye } from './camera'

export interface Ground {
  /** The place below a pixel, or a guess where no point is there. */
  below(x: number, y: number): Vector3
  moved(): void
  size(): { width: number; height: number }
}

export class Controls {
  #pivot = new Vector3()
  #pivotUntil = 0
  readonly #pointers = new Map<number, { x: number; y: number }>()
  /** True while a drag is under way that has moved. */
  dragging = false

  constructor(
    readonly element: HTMLElement,
    readonly eye: Eye,
    readonly ground: Ground,
  ) {
    element.addEventListener('pointerdown', (event) => this.#down(event))
    element.addEventListener('pointermove', (event) => this.#move(event))
    for (const name of ['pointerup', 'pointercancel'] as const) element.addEventListener(name, (event) => this.#up(event))
    element.addEventListener('wheel', (event) => this.#wheel(event), { passive: false })
    element.addEventListener('contextmenu', (event) => event.preventDefault())
    element.addEventListener('keydown', (event) => this.#key(event))
  }

  #at(event: MouseEvent): { x: number; y: number } {
    const box = this.element.getBoundingClientRect()
    return { x: event.clientX - box.left, y: event.clientY - box.top }
  }

  #down(event: PointerEvent): void {
    const at = this.#at(event)
    this.#pointers.set(event.pointerId, at)
    if (this.#pointers.size === 1) this.dragging = false
    this.#pivot = this.ground.below(at.x, at.y)
  }

  #move(event: PointerEvent): void {
    const before = this.#pointers.get(event.pointerId)
    if (!before) return
    const at = this.#at(event)
    const [dx, dy] = [at.x - before.x, at.y - before.y]
    if (!this.dragging && Math.hypot(dx, dy) < 3) return
    if (!this.dragging) this.element.setPointerCapture(event.pointerId)
    this.dragging = true
    if (this.#pointers.size === 2) this.#pinch(event.pointerId, before, at)
    else if (event.buttons & 1 && !event.shiftKey && !event.ctrlKey) this.#orbit(dx, dy)
    else this.#pan(before, at)
    this.#pointers.set(event.pointerId, at)
    this.ground.moved()
  }

  #up(event: PointerEvent): void {
    this.#pointers.delete(event.pointerId)
  }

  #orbit(dx: number, dy: number): void {
    const { width, height } = this.ground.size()
    this.eye.orbit(this.#pivot, (dx / width) * Math.PI, (dy / height) * Math.PI * 0.6)
  }

  /** Move so that the pivot's plane follows the pointer. */
  #pan(before: { x: number; y: number }, at: { x: number; y: number }): void {
    const { width, height } = this.ground.size()
    const steep = this.eye.tilt > 0.25
    const normal = steep ? new Vector3(0, 0, 1) : this.eye.direction()
    const meets = ({ x, y }: { x: number; y: number }): Vector3 | null => {
      const ray = this.eye.ray(x, y, width, height)
      const slope = ray.dot(normal)
      const distance = this.#pivot.clone().sub(this.eye.place).dot(normal) / slope
      return Math.abs(slope) < 0.02 || distance <= 0 ? null : this.eye.place.clone().addScaledVector(ray, distance)
    }
    const [from, to] = [meets(before), meets(at)]
    if (from && to) this.eye.move(from.sub(to))
  }

  #pinch(moved: number, before: { x: number; y: number }, at: { x: number; y: number }): void {
    const other = [...this.#pointers].find(([id]) => id !== moved)![1]
    const [was, is] = [Math.hypot(before.x - other.x, before.y - other.y), Math.hypot(at.x - other.x, at.y - other.y)]
    if (is > 0) this.eye.approach(this.#pivot, was / is)
    this.#pan({ x: (before.x + other.x) / 2, y: (before.y + other.y) / 2 }, { x: (at.x + other.x) / 2, y: (at.y + other.y) / 2 })
  }

  #wheel(event: WheelEvent): void {
    event.preventDefault()
    const at = this.#at(event)
    if (performance.now() > this.#pivotUntil) this.#pivot = this.ground.below(at.x, at.y)
    this.#pivotUntil = performance.now() + 250
    const lines = event.deltaMode === 1 ? event.deltaY * 30 : event.deltaY
    this.eye.approach(this.#pivot, Math.exp(Math.max(-200, Math.min(200, lines)) * 0.0018))
    this.ground.moved()
  }

  #key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return
    const { width, height } = this.ground.size()
    const pivot = this.ground.below(width / 2, height / 2)
    const step = pivot.distanceTo(this.eye.place) * 0.12
    const [ahead, right] = [new Vector3(Math.sin(this.eye.heading), Math.cos(this.eye.heading), 0), this.eye.right()]
    const turn = event.shiftKey
    switch (event.key) {
      case 'ArrowUp':
        turn ? this.eye.orbit(pivot, 0, 0.1) : this.eye.move(ahead.multiplyScalar(step))
        break
      case 'ArrowDown':
        turn ? this.eye.orbit(pivot, 0, -0.1) : this.eye.move(ahead.multiplyScalar(-step))
        break
      case 'ArrowLeft':
        turn ? this.eye.orbit(pivot, -0.12, 0) : this.eye.move(right.multiplyScalar(-step))
        break
      case 'ArrowRight':
        turn ? this.eye.orbit(pivot, 0.12, 0) : this.eye.move(right.multiplyScalar(step))
        break
      case '+':
      case '=':
        this.eye.approach(pivot, 0.8)
        break
      case '-':
        this.eye.approach(pivot, 1.25)
        break
      default:
        return
    }
    event.preventDefault()
    this.ground.moved()
  }
}
