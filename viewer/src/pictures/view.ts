/** Pictures: one large, with the place marked; below it those that see the place, best first. */

import type { Desk, Place } from '../core/desk'
import { fill, h, iconButton } from '../core/dom'
import * as format from '../core/format'
import { Signal } from '../core/signal'
import type { Camera } from '../core/site'
import { meet, rayNear } from '../cloud/pick'
import type { CloudStore } from '../cloud/store'
import { anglesOf, pixelAtAngles, pixelOf, pixelSize, rayOf } from './geometry'
import type { Picture, PictureList, View } from './list'
import { Panorama } from './panorama'

export type PictureTool = 'select' | 'line' | 'stereo' | 'control'

/** A line, or dots, over a picture: pixels of the camera. */
export interface PictureDrawing {
  points: readonly (readonly [number, number])[]
  /** With a dot at each point. */
  dots: boolean
  label?: string
}

const OFFERED = 24
const CHECKED = 8
const RAY_POINTS = 2_000_000
/** Decoded pictures that are kept; one of 360° may take half of this. */
const KEPT_BYTES = 256e6
/** Least half angle (radian) within which points count as met by a ray: about two pixels of a common camera. */
const CONE = 1.5e-3

/** Half angle (radian) within which a point before a place hides it. */
const HIDING = 4 * CONE
/** Depth (m) of a hole, or height of a stone, that is no obstacle. */
const ROUGH_M = 0.1

/** Length of a ray's end (m) that tells nothing: there, the ground about the place lies within the cone of a ray that falls by `slope`. */
function untold(size_m: number, slope: number): number {
  const above = slope > 0 ? (ROUGH_M + HIDING * size_m) / (slope + HIDING) : 0
  return Math.max(0.4, 0.04 * size_m, Math.min(size_m / 4, above))
}

export class PictureView {
  readonly element: HTMLElement
  readonly tool = new Signal<PictureTool>('select')
  /** Gets the pixels that are clicked while a tool is chosen, and the double click that ends a line. */
  clicked: (picture: Picture, u: number, v: number) => void = () => {}
  ended: () => void = () => {}
  /** By name: what is drawn over a picture. */
  readonly #drawings = new Map<string, (picture: Picture) => PictureDrawing[]>()
  readonly #frame = h('div', { class: 'picture-frame', tabindex: 0, role: 'application', 'aria-label': 'Picture. Arrow keys move it, plus and minus zoom, a click on a pixel gives its place.' })
  readonly #flat = h('canvas', { class: 'picture-canvas' })
  readonly #ball = h('canvas', { class: 'picture-canvas', hidden: true })
  readonly #marks = h('canvas', { class: 'picture-marks', 'aria-hidden': 'true' })
  readonly #caption = h('p', { class: 'picture-caption', 'aria-live': 'polite' })
  readonly #list = h('div', { class: 'picture-list', role: 'list', 'aria-label': 'Pictures that see the place' })
  #panorama: Panorama | null = null
  #picture: Picture | null = null
  #bitmap: ImageBitmap | null = null
  #view = { x: 0, y: 0, zoom: 1 }
  /** Size of the frame that the view was made for. */
  #fitted = [0, 0]
  #views: View[] = []
  #place: Place | null = null
  /** Counts what people ask for; an answer to what was asked before changes nothing. */
  #turn = 0
  #drag: { x: number; y: number; moved: boolean } | null = null
  /** Pictures by their URL, those asked for longest ago first; a size of 0 while one is loading. */
  readonly #held = new Map<string, { loading: Promise<ImageBitmap>; bytes: number }>()

  constructor(
    readonly desk: Desk,
    readonly pictures: PictureList,
    readonly cloud: () => Promise<CloudStore | null>,
  ) {
    this.#frame.append(this.#flat, this.#ball, this.#marks)
    this.element = h(
      'div',
      { class: 'picture-view' },
      this.#frame,
      h(
        'div',
        { class: 'view-buttons' },
        iconButton('plus', 'Zoom in (+)', () => this.#zoom(1.5)),
        iconButton('minus', 'Zoom out (-)', () => this.#zoom(1 / 1.5)),
        iconButton('fit', 'All of the picture (0)', () => this.#fit()),
        iconButton('left', 'Picture before', () => void this.#step(-1)),
        iconButton('right', 'Next picture', () => void this.#step(1)),
      ),
      this.#caption,
      this.#list,
    )
    this.#listen()
  }

  get current(): Picture | null {
    return this.#picture
  }

  #listen(): void {
    const frame = this.#frame
    frame.addEventListener('pointerdown', (event) => {
      this.#drag = { x: event.clientX, y: event.clientY, moved: false }
      frame.setPointerCapture(event.pointerId)
    })
    frame.addEventListener('pointermove', (event) => this.#dragTo(event))
    frame.addEventListener('pointerup', (event) => {
      const drag = this.#drag
      this.#drag = null
      if (drag && !drag.moved) void this.#click(event.clientX, event.clientY)
    })
    frame.addEventListener('dblclick', () => this.tool.value !== 'select' && this.ended())
    frame.addEventListener('wheel', (event) => {
      event.preventDefault()
      const box = frame.getBoundingClientRect()
      this.#zoom(Math.exp(-event.deltaY * 0.0015), event.clientX - box.left, event.clientY - box.top)
    }, { passive: false })
    frame.addEventListener('keydown', (event) => this.#key(event))
    new ResizeObserver(() => this.#fit()).observe(frame)
  }

  #key(event: KeyboardEvent): void {
    const steps: Record<string, [number, number]> = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }
    if (event.key in steps) this.#shift(...steps[event.key]!)
    else if (event.key === '+' || event.key === '=') this.#zoom(1.3)
    else if (event.key === '-') this.#zoom(1 / 1.3)
    else if (event.key === '0') this.#fit()
    else if (event.key === 'PageDown') void this.#step(1)
    else if (event.key === 'PageUp') void this.#step(-1)
    else if (event.key === 'Enter' && event.shiftKey && this.tool.value !== 'select') this.ended()
    else if (event.key === 'Enter') {
      const box = this.#frame.getBoundingClientRect()
      void this.#click(box.left + box.width / 2, box.top + box.height / 2)
    } else return
    event.preventDefault()
  }

  #dragTo(event: PointerEvent): void {
    const drag = this.#drag
    if (!drag) return
    const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y]
    if (!drag.moved && Math.hypot(dx, dy) < 4) return
    this.#drag = { x: event.clientX, y: event.clientY, moved: true }
    this.#shift(dx, dy)
  }

  #shift(dx: number, dy: number): void {
    if (this.#around && this.#panorama) {
      const scale = this.#panorama.angle / this.#frame.clientHeight
      this.#panorama.yaw -= dx * scale
      this.#panorama.pitch = Math.max(-1.5, Math.min(1.5, this.#panorama.pitch - dy * scale))
    } else {
      this.#view.x += dx
      this.#view.y += dy
    }
    this.#draw()
  }

  get #around(): boolean {
    return this.#picture?.camera.model === 'equirectangular'
  }

  // ---- which pictures ----

  /** The pictures that see a place; the best is opened. */
  async showPlace(place: Place): Promise<void> {
    const turn = ++this.#turn
    this.#place = place
    this.#frame.dataset['state'] = 'loading'
    const at = [place.easting_m, place.northing_m, place.height_m ?? this.desk.survey.height_extent_m?.[0] ?? 0] as const
    const views = (await this.pictures.seeing(at)).slice(0, OFFERED)
    if (turn !== this.#turn) return
    this.#views = views
    this.#drawList()
    if (!views.length) {
      this.#caption.textContent = 'No picture sees this place.'
      return
    }
    await this.#findHidden(at)
    if (turn !== this.#turn) return
    this.#views = [...views.filter((one) => !one.hidden), ...views.filter((one) => one.hidden)]
    await this.#open(this.#views[0]!.picture)
  }

  /** Ask the cloud whether something stands before the place: a picture in which it is hidden comes last. */
  async #findHidden(at: readonly [number, number, number]): Promise<void> {
    const store = await this.cloud().catch(() => null)
    if (!store) return
    for (const view of this.#views.slice(0, CHECKED)) {
      const { picture } = view
      const from = [picture.easting_m, picture.northing_m, picture.height_m] as const
      const by = [0, 1, 2].map((axis) => at[axis]! - from[axis]!) as [number, number, number]
      const size = Math.hypot(...by)
      const direction = by.map((one) => one / size) as [number, number, number]
      const ray = { from, direction }
      const nodes = store.ready().filter((node) => rayNear(node.box, ray, HIDING, size))
      const met = meet(store, nodes, ray, HIDING, 1, size - untold(size, -direction[2]))
      view.hidden = met !== null
    }
  }

  /** Open a picture by its path, and mark a place in it. */
  async openUrl(url: string, place: Place | null): Promise<void> {
    const picture = await this.pictures.byUrl(url)
    if (place) this.#place = place
    if (picture) await this.open(picture)
    else this.desk.complain(`the picture ${url} is not in the list of pictures`)
  }

  async openFirst(): Promise<void> {
    if (this.#turn) return // something was asked for already
    if (this.desk.place.value) return this.showPlace(this.desk.place.value)
    const { extent_m } = this.desk.survey
    const [e, n] = [(extent_m[0] + extent_m[2]) / 2, (extent_m[1] + extent_m[3]) / 2]
    const near = await this.pictures.near(e, n, Infinity)
    const apart = (one: Picture): number => Math.hypot(one.easting_m - e, one.northing_m - n)
    const first = near.reduce<Picture | null>((best, one) => (!best || apart(one) < apart(best) ? one : best), null)
    if (first && !this.#turn) await this.open(first)
  }

  /** Draw something over the pictures; null removes it. */
  setDrawings(name: string, drawings: ((picture: Picture) => PictureDrawing[]) | null): void {
    if (drawings) this.#drawings.set(name, drawings)
    else this.#drawings.delete(name)
    this.#draw()
  }

  /** Offer pictures in the list below. */
  offer(views: View[]): void {
    this.#views = views.slice(0, OFFERED)
    this.#drawList()
  }

  async #step(by: number): Promise<void> {
    const now = this.#picture
    if (!now) return
    const beside = (await this.pictures.near(now.easting_m, now.northing_m)).filter((one) => one.camera === now.camera).sort((a, b) => a.id - b.id)
    const next = beside[beside.indexOf(now) + by]
    if (next) await this.open(next)
    else this.desk.say('There is no further picture of this camera.')
  }

  /** Open a picture that people chose. */
  async open(picture: Picture): Promise<void> {
    this.#turn++
    await this.#open(picture)
  }

  async #open(picture: Picture): Promise<void> {
    this.#picture = picture
    this.#frame.dataset['state'] = 'loading'
    this.#caption.textContent = `Loading ${picture.camera.title} …`
    this.#drawList()
    const bitmap = await this.#load(picture.url)
    if (this.#picture !== picture) return
    this.#bitmap = bitmap
    this.#flat.hidden = this.#around
    this.#ball.hidden = !this.#around
    if (this.#around) await this.#openBall(bitmap, picture.camera)
    if (this.#picture !== picture) return
    this.#fit()
    this.#lookAtPlace()
    const sigma = picture.sigma_m === null ? '' : `  σ ${format.length(picture.sigma_m)}`
    this.#caption.textContent = [picture.camera.run, picture.camera.title, picture.name, format.gpsTime(picture.epoch_gps_ns)].filter(Boolean).join(' · ') + sigma
    this.desk.picture.value = picture.id
    this.#frame.dataset['state'] = 'shown'
  }

  async #openBall(bitmap: ImageBitmap, camera: Camera): Promise<void> {
    this.#panorama ??= new Panorama(this.#ball)
    await this.#panorama.load(bitmap, camera)
  }

  #load(url: string): Promise<ImageBitmap> {
    const known = this.#held.get(url)
    if (known) return known.loading
    const type = url.endsWith('.png') ? 'image/png' : 'image/jpeg'
    const loading = this.desk.source.blob(url, type).then((blob) => createImageBitmap(blob))
    const one = { loading, bytes: 0 }
    this.#held.set(url, one)
    loading.then(
      (bitmap) => {
        one.bytes = bitmap.width * bitmap.height * 4
        this.#forget(url)
      },
      () => this.#held.delete(url),
    )
    return loading
  }

  /** Let go of the pictures that came first, where all that are held take too much memory beside the newest. */
  #forget(newest: string): void {
    let sum = [...this.#held.values()].reduce((all, one) => all + one.bytes, 0)
    for (const [url, one] of this.#held) {
      if (sum <= KEPT_BYTES) return
      if (url === newest || !one.bytes) continue
      sum -= one.bytes
      this.#held.delete(url)
    }
  }

  #drawList(): void {
    fill(
      this.#list,
      ...this.#views.map((view) =>
        h(
          'button',
          {
            type: 'button',
            role: 'listitem',
            'aria-current': view.picture === this.#picture ? 'true' : null,
            class: view.hidden ? 'dim' : '',
            onclick: () => this.open(view.picture).catch((error) => this.desk.complain(error)),
          },
          h('span', {}, view.picture.camera.title),
          h('span', { class: 'number' }, view.note ?? `${format.fixed(view.distance_m, 1)} m`),
          view.note ? null : h('span', { class: 'number' }, `${format.fixed(view.pixel_m * 1000, 1)} mm/px`),
          view.hidden ? h('span', {}, 'behind something') : null,
        ),
      ),
    )
  }

  // ---- the picture ----

  #fit(): void {
    const [width, height] = [this.#frame.clientWidth, this.#frame.clientHeight]
    this.#fitted = [width, height]
    const ratio = Math.min(2, window.devicePixelRatio || 1)
    for (const canvas of [this.#flat, this.#ball, this.#marks]) [canvas.width, canvas.height] = [Math.max(1, width * ratio), Math.max(1, height * ratio)]
    if (this.#bitmap) {
      const zoom = Math.min(width / this.#bitmap.width, height / this.#bitmap.height)
      this.#view = { x: (width - this.#bitmap.width * zoom) / 2, y: (height - this.#bitmap.height * zoom) / 2, zoom }
    }
    if (this.#panorama) this.#panorama.angle = 1.2
    this.#draw()
  }

  /** Turn or move the picture so that the marked place is in sight. */
  #lookAtPlace(): void {
    const pixel = this.#markedPixel()
    if (!pixel || !this.#picture || !this.#around || !this.#panorama) return
    ;[this.#panorama.yaw, this.#panorama.pitch] = anglesOf(this.#picture.camera, ...pixel)
    this.#draw()
  }

  #zoom(factor: number, x = this.#frame.clientWidth / 2, y = this.#frame.clientHeight / 2): void {
    if (this.#around && this.#panorama) this.#panorama.angle = Math.max(0.05, Math.min(2.4, this.#panorama.angle / factor))
    else {
      const zoom = Math.max(0.02, Math.min(40, this.#view.zoom * factor))
      const by = zoom / this.#view.zoom
      this.#view = { zoom, x: x - (x - this.#view.x) * by, y: y - (y - this.#view.y) * by }
    }
    this.#draw()
  }

  /** The pixel of the picked place in this picture. */
  #markedPixel(): [number, number] | null {
    const place = this.#place ?? this.desk.place.value
    if (!place || !this.#picture || place.height_m === null) return null
    const pixel = pixelOf(this.#picture.camera, this.#picture, [place.easting_m, place.northing_m, place.height_m])
    return pixel && [pixel.u, pixel.v]
  }

  /** A picture may be published smaller than it was taken. */
  get #shrunk(): number {
    return this.#bitmap!.width / this.#picture!.camera.width_px
  }

  /** Point of the frame (CSS pixels) of a pixel of the camera. */
  #screenOf(u: number, v: number): [number, number] | null {
    const { camera } = this.#picture!
    if (this.#around && this.#panorama) {
      const at = this.#panorama.pointOf(...anglesOf(camera, u, v))
      return at && [at[0] * this.#frame.clientWidth, at[1] * this.#frame.clientHeight]
    }
    const scale = this.#view.zoom * this.#shrunk
    return [this.#view.x + (u + 0.5) * scale, this.#view.y + (v + 0.5) * scale]
  }

  #pixelAt(x: number, y: number): [number, number] {
    const { camera } = this.#picture!
    if (this.#around && this.#panorama) {
      return pixelAtAngles(camera, ...this.#panorama.directionAt(x / this.#frame.clientWidth, y / this.#frame.clientHeight))
    }
    const scale = this.#view.zoom * this.#shrunk
    return [(x - this.#view.x) / scale - 0.5, (y - this.#view.y) / scale - 0.5]
  }

  #draw(): void {
    if (!this.#bitmap || !this.#picture) return
    const ratio = this.#flat.width / Math.max(1, this.#frame.clientWidth)
    if (this.#around) this.#panorama?.draw()
    else {
      const context = this.#flat.getContext('2d')!
      context.setTransform(1, 0, 0, 1, 0, 0)
      context.clearRect(0, 0, this.#flat.width, this.#flat.height)
      context.imageSmoothingEnabled = this.#view.zoom < 3
      context.setTransform(ratio * this.#view.zoom, 0, 0, ratio * this.#view.zoom, ratio * this.#view.x, ratio * this.#view.y)
      context.drawImage(this.#bitmap, 0, 0)
    }
    this.#drawMark(ratio)
  }

  #drawMark(ratio: number): void {
    const context = this.#marks.getContext('2d')!
    context.setTransform(ratio, 0, 0, ratio, 0, 0)
    context.clearRect(0, 0, this.#marks.width, this.#marks.height)
    for (const drawings of this.#drawings.values()) for (const one of drawings(this.#picture!)) this.#drawOver(context, one)
    const pixel = this.#markedPixel()
    const at = pixel && this.#screenOf(...pixel)
    this.#frame.dataset['mark'] = pixel ? pixel.map((one) => one.toFixed(2)).join(' ') : ''
    if (!at) return
    for (const [width, colour] of [[4.5, '#000'], [2, '#ffd43b']] as const) {
      context.beginPath()
      context.arc(at[0], at[1], 11, 0, 2 * Math.PI)
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]] as const) {
        context.moveTo(at[0] + dx * 5, at[1] + dy * 5)
        context.lineTo(at[0] + dx * 18, at[1] + dy * 18)
      }
      ;[context.lineWidth, context.strokeStyle] = [width, colour]
      context.stroke()
    }
  }

  #drawOver(context: CanvasRenderingContext2D, { points, dots, label }: PictureDrawing): void {
    const places = points.map(([u, v]) => this.#screenOf(u, v))
    for (const [width, colour] of [[5, 'rgba(0,0,0,.7)'], [2, '#ffd43b']] as const) {
      context.beginPath()
      let before: [number, number] | null = null
      for (const at of places) {
        if (at && before) context.lineTo(...at)
        else if (at) context.moveTo(...at)
        before = at
      }
      ;[context.lineWidth, context.strokeStyle, context.fillStyle] = [width, colour, colour]
      context.stroke()
      for (const at of dots ? places : []) {
        if (!at) continue
        context.beginPath()
        context.arc(at[0], at[1], 2 + width / 2, 0, 2 * Math.PI)
        context.fill()
      }
    }
    const end = places.at(-1)
    if (!label || !end) return
    ;[context.font, context.lineWidth, context.strokeStyle] = ['600 13px system-ui, sans-serif', 4, 'rgba(0,0,0,.8)']
    context.strokeText(label, end[0] + 10, end[1] - 8)
    context.fillText(label, end[0] + 10, end[1] - 8)
  }

  // ---- from a pixel to the place ----

  async #click(clientX: number, clientY: number): Promise<void> {
    const picture = this.#picture
    if (!picture || !this.#bitmap) return
    const box = this.#frame.getBoundingClientRect()
    if (this.#frame.clientWidth !== this.#fitted[0] || this.#frame.clientHeight !== this.#fitted[1]) this.#fit() // the observer has not told yet
    const [u, v] = this.#pixelAt(clientX - box.left, clientY - box.top)
    if (this.tool.value !== 'select') return this.clicked(picture, u, v)
    await this.placeOf(picture, u, v, Math.max(CONE, this.#pixelAngle()))
  }

  /** The angle (radian) of a pixel of the picture, or of the screen where that is larger: nobody points closer. */
  #pixelAngle(): number {
    if (this.#around && this.#panorama) return this.#panorama.angle / Math.max(1, this.#frame.clientHeight)
    return pixelSize(this.#picture!.camera, 1) / Math.min(1, this.#view.zoom * this.#shrunk)
  }

  /** The place that a pixel shows: where its ray meets the cloud first. */
  async placeOf(picture: Picture, u: number, v: number, cone: number): Promise<void> {
    const turn = ++this.#turn
    const store = await this.cloud()
    if (!store) {
      this.desk.say('This site holds no point cloud, so a pixel has no place.')
      return
    }
    this.desk.say('Looking for the point …')
    const ray = { from: [picture.easting_m, picture.northing_m, picture.height_m] as const, direction: rayOf(picture.camera, picture, u, v) }
    const { nodes } = await store.within((one) => rayNear(one, ray, cone * 2, 80), RAY_POINTS)
    if (turn !== this.#turn) return
    const met = meet(store, nodes, ray, cone, 0.8, 80) ?? meet(store, nodes, ray, cone * 3, 0.8, 80)
    if (!met) {
      this.desk.say('The ray of this pixel meets no point within 80 m.')
      return
    }
    const { coordinate } = met
    this.desk.message.value = null
    this.#place = {
      easting_m: coordinate[0],
      northing_m: coordinate[1],
      height_m: coordinate[2],
      from: 'picture',
      notes: [
        ['Distance', format.metres(met.distance_m, 2)],
        ['Point beside the ray', format.length(met.apart_m)],
      ],
    }
    this.desk.place.value = this.#place
    const views = (await this.pictures.seeing(coordinate)).slice(0, OFFERED)
    if (turn !== this.#turn) return
    this.#views = views
    this.#drawList()
    this.#draw()
  }

  /** Show another place's mark in the picture that is open. */
  mark(place: Place | null): void {
    this.#place = place
    this.#draw()
  }
}
