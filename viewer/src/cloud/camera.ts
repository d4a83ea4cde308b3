/** The eye over the cloud: a place in double precision, a heading and a tilt. Metres from the scene's origin, z up. */

import { Matrix4, PerspectiveCamera, Vector3 } from 'three'

const STEEPEST = Math.PI / 2 - 1e-4

export class Eye {
  readonly camera = new PerspectiveCamera(55, 1, 0.1, 10_000)
  readonly place = new Vector3(0, -50, 40)
  /** Clockwise from north, and downwards (radians). */
  heading = 0
  tilt = 0.7

  /** Where it looks. */
  direction(): Vector3 {
    const level = Math.cos(this.tilt)
    return new Vector3(Math.sin(this.heading) * level, Math.cos(this.heading) * level, -Math.sin(this.tilt))
  }

  right(): Vector3 {
    return new Vector3(Math.cos(this.heading), -Math.sin(this.heading), 0)
  }

  /** Set the camera's matrices; `nearest` and `farthest` bound what is seen (m). */
  apply(width: number, height: number, nearest: number, farthest: number): void {
    const { camera } = this
    camera.aspect = width / Math.max(1, height)
    camera.near = Math.max(0.02, nearest * 0.5)
    camera.far = Math.max(camera.near * 10, farthest * 1.5)
    camera.updateProjectionMatrix()
    const [ahead, right] = [this.direction(), this.right()]
    const up = new Vector3().crossVectors(right, ahead)
    camera.position.copy(this.place)
    camera.quaternion.setFromRotationMatrix(new Matrix4().makeBasis(right, up, ahead.clone().negate()))
    camera.updateMatrixWorld(true)
  }

  /** Pixels of a metre that is a metre away. */
  focal(height: number): number {
    return height / 2 / Math.tan((this.camera.fov * Math.PI) / 360)
  }

  /** Turn about a place that stays where it is on the screen. */
  orbit(about: Vector3, clockwise: number, down: number): void {
    const tilt = Math.max(-STEEPEST, Math.min(STEEPEST, this.tilt + down))
    const arm = this.place.clone().sub(about)
    arm.applyAxisAngle(this.right(), -(tilt - this.tilt))
    arm.applyAxisAngle(new Vector3(0, 0, 1), -clockwise)
    this.tilt = tilt
    this.heading += clockwise
    this.place.copy(about).add(arm)
  }

  /** Come nearer to a place by a factor below 1, or leave it by one above. */
  approach(about: Vector3, factor: number): void {
    const arm = this.place.clone().sub(about)
    const length = arm.length() * factor
    if (length < 0.05 || length > 200_000) return
    this.place.copy(about).addScaledVector(arm.normalize(), length)
  }

  move(by: Vector3): void {
    this.place.add(by)
  }

  /** Look at a place from so far away. */
  lookAt(at: Vector3, distance: number): void {
    this.place.copy(at).addScaledVector(this.direction(), -distance)
  }

  /** The ray through a pixel, as a direction of length 1. */
  ray(x: number, y: number, width: number, height: number): Vector3 {
    const point = new Vector3((x / width) * 2 - 1, 1 - (y / height) * 2, 0.5).unproject(this.camera)
    return point.sub(this.place).normalize()
  }
}
