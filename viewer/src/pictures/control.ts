/** Control points, clicked in the pictures that see them: each click is written by the server before it counts. */

import type { Desk } from '../core/desk'
import { fill, h, iconButton } from '../core/dom'
import * as format from '../core/format'
import { post, Refused } from '../core/server'
import type { Picture, PictureList } from './list'
import { copyText } from '../panels/row'

type Pixel = [number, number]

interface ControlPoint {
  name: string
  role: string
  easting_m: number
  northing_m: number
  height_m: number
}

interface Measured {
  point: string
  picture: string
  pixel: Pixel
  source: string
}

/** A picture that sees the point, and where it is to be expected in it. */
interface Sight {
  name: string
  u_px: number
  v_px: number
  sigma_u_px: number
  sigma_v_px: number
  distance_m: number
  resolution_m: number
  /** σ that nothing states, which the ellipse lacks. */
  assumed: string
  /** Measured in another log of the survey. */
  elsewhere: Measured | null
}

interface Answer {
  file: string
  points: ControlPoint[]
  measured: Measured[]
  missing: { where: string; text: string }[]
  pictures?: Sight[]
}

/** Size of a tile (CSS pixels). */
const [WIDTH, HEIGHT] = [204, 164]
/** Below so many CSS pixels a pixel, a click enlarges in place of measuring. */
const FINE = 3
/** Enlargement at which a place is clicked. */
const CLOSE = 7
/** At least so many pixels around the expected place are shown. */
const LEAST_PX = 16

export class ControlPanel {
  readonly element = h('section', { class: 'control-panel', 'aria-label': 'Control points in pictures', hidden: true })
  readonly #choice = h('select', { 'aria-label': 'Control point', onchange: () => void this.choose(this.#choice.value) })
  readonly #undo = iconButton('undo', 'Take the last click back', () => this.#takeBack(), { disabled: true })
  readonly #tiles = h('div', { class: 'control-tiles' })
  readonly #below = h('footer', { class: 'control-below', 'aria-live': 'polite' })
  #state: Answer | null = null
  #shown: ControlTile[] = []
  #point = ''
  /** What this window wrote, the last at the end. */
  readonly #done: { point: string; picture: string; pixel: Pixel | null; before: Pixel | null }[] = []
  /** Clicks are written one after another. */
  #queue: Promise<unknown> = Promise.resolve()
  #waiting = 0

  constructor(
    readonly desk: Desk,
    readonly list: PictureList,
    readonly path: string,
    readonly token: string,
  ) {
    const step = (by: number): void => {
      const names = this.#state?.points.map((one) => one.name) ?? []
      const next = names[names.indexOf(this.#point) + by]
      if (next) void this.choose(next)
    }
    this.element.append(
      h('header', { class: 'control-head' }, iconButton('left', 'Point before', () => step(-1)), this.#choice, iconButton('right', 'Next point', () => step(1)), this.#undo),
      this.#tiles,
      this.#below,
    )
    desk.selected.on((selected) => {
      if (selected?.layer.name === 'control' && !this.element.hidden) void this.choose(String(selected.feature.properties['name']))
    })
    window.addEventListener('beforeunload', (event) => {
      if (this.#waiting || this.#shown.some((one) => one.unwritten)) event.preventDefault()
    })
    window.addEventListener('focus', () => void (!this.element.hidden && this.#ask({ action: 'list' }).catch(() => {})))
  }

  /** Show the panel with the point that is selected on the map, else the one that was shown, else the first. */
  async open(point = ''): Promise<void> {
    this.element.hidden = false
    const selected = this.desk.selected.value
    const named = point || (selected?.layer.name === 'control' ? String(selected.feature.properties['name']) : this.#point)
    try {
      if (!this.#state) await this.#ask({ action: 'list' })
      const known = this.#state!.points.find((one) => one.name === named) ?? this.#state!.points[0]
      if (known && (known.name !== this.#point || !this.#shown.length)) await this.choose(known.name)
    } catch (error) {
      this.desk.complain(error)
    }
  }

  /** Show the pictures that see a point. */
  async choose(point: string): Promise<void> {
    if (this.#shown.some((one) => one.unwritten)) return this.desk.complain('A click is not written yet: write it, or take it back.')
    this.#point = point
    this.#tiles.dataset['state'] = 'loading'
    try {
      const { points, pictures = [] } = await this.#ask({ action: 'show', point })
      if (this.#point !== point) return
      const known = points.find((one) => one.name === point)!
      const all = new Map((await this.list.near(known.easting_m, known.northing_m)).map((one) => [one.name, one]))
      this.desk.place.value = { easting_m: known.easting_m, northing_m: known.northing_m, height_m: known.height_m, from: 'control point' }
      this.desk.goTo({ easting_m: known.easting_m, northing_m: known.northing_m, height_m: known.height_m, across_m: 30 })
      this.#shown = pictures.flatMap((sight) => {
        const picture = all.get(sight.name)
        return picture ? [new ControlTile(this.desk, picture, sight, (tile, pixel) => this.#put(tile, pixel))] : []
      })
      fill(this.#tiles, ...this.#shown.map((one) => one.element))
      if (!this.#shown.length) fill(this.#tiles, h('p', { class: 'hint' }, `No picture sees ${point}.`))
      this.#draw()
      for (const one of [...this.#shown]) if (this.#point === point) await one.load() // one by one: a picture may be large
      this.#tiles.dataset['state'] = 'shown'
    } catch (error) {
      this.desk.complain(error)
    }
  }

  async #ask(asked: object): Promise<Answer> {
    const answer = await post<Answer>(this.path, JSON.stringify(asked), this.token)
    this.#state = answer
    this.#draw()
    return answer
  }

  /** Write a click, or remove one; the tile keeps it until the server has it. */
  #put(tile: ControlTile, pixel: Pixel | null): void {
    const [point, picture] = [this.#point, tile.sight.name]
    tile.unwritten = { pixel, failed: false }
    this.#waiting++
    tile.draw()
    this.#queue = this.#queue.then(() => this.#write(point, picture, pixel, tile)).finally(() => {
      this.#waiting--
      this.#draw()
    })
  }

  async #write(point: string, picture: string, pixel: Pixel | null, tile: ControlTile | null): Promise<boolean> {
    const before = this.#measured(point, picture)
    try {
      await this.#ask({ action: 'put', point, picture, pixel, before })
      if (tile) {
        tile.unwritten = null
        this.#done.push({ point, picture, pixel, before })
      }
      return true
    } catch (error) {
      this.desk.complain(error)
      if (tile) tile.unwritten = error instanceof Refused ? null : { pixel, failed: true }
      if (error instanceof Refused) await this.#ask({ action: 'list' }).catch(() => {}) // what stands there now
      return false
    }
  }

  #takeBack(): void {
    const failed = this.#shown.find((one) => one.unwritten?.failed)
    if (failed) {
      failed.unwritten = null
      return this.#draw()
    }
    const last = this.#done.pop()
    if (!last) return
    this.#queue = this.#queue.then(async () => {
      if (!(await this.#write(last.point, last.picture, last.before, null))) return
      if (last.point !== this.#point) await this.choose(last.point)
      this.desk.say(`${last.point} in ${last.picture}: taken back.`)
    })
    this.#draw()
  }

  #measured(point: string, picture: string): Pixel | null {
    return this.#state?.measured.find((one) => one.point === point && one.picture === picture)?.pixel ?? null
  }

  #draw(): void {
    const state = this.#state
    if (!state) return
    const count = (point: string): number => state.measured.filter((one) => one.point === point).length
    fill(this.#choice, ...state.points.map((one) => h('option', { value: one.name, selected: one.name === this.#point }, `${one.name} · ${one.role === 'check' ? 'check' : 'control'} · ${count(one.name)} measured`)))
    this.#choice.value = this.#point
    this.#undo.disabled = !this.#done.length && !this.#shown.some((one) => one.unwritten?.failed)
    for (const tile of this.#shown) {
      tile.measured = this.#measured(this.#point, tile.sight.name)
      tile.draw()
    }
    const all = state.measured.length
    const assumed = [...new Set(this.#shown.map((one) => one.sight.assumed).filter(Boolean))].join('; ')
    fill(
      this.#below,
      h('p', {}, `Click the point in each picture: it is written at once into ${state.file} (${all} in all). Yellow: where it is to be expected, with 3 σ${assumed && ` (${assumed})`}.`),
      ...(all ? state.missing : []).map(({ where, text }) =>
        h('div', { class: 'control-missing' }, h('p', {}, `Add to the survey file, ${where}:`), h('pre', {}, text), iconButton('copy', 'Copy the lines', () => void copyText(`\n${text}\n`).then(() => this.desk.say('The lines are in the clipboard.')), { class: 'icon-button small' }))),
      all && !state.missing.length ? h('p', {}, 'The survey file takes them: roadscan run adjusts with them.') : null,
    )
    this.element.dataset['measured'] = String(all)
    this.element.dataset['waiting'] = String(this.#waiting)
  }
}

/** A picture around the place where a control point is to be expected. */
class ControlTile {
  readonly #canvas = h('canvas', { class: 'control-canvas', tabindex: 0, role: 'application' })
  readonly #state = h('span', { class: 'number' })
  readonly #again = h('button', { type: 'button', hidden: true, onclick: () => this.put(this, this.unwritten?.pixel ?? null) }, 'Write again')
  readonly #remove = iconButton('close', 'Remove the measurement', () => this.put(this, null), { class: 'icon-button small', hidden: true })
  readonly element: HTMLElement
  measured: Pixel | null = null
  unwritten: { pixel: Pixel | null; failed: boolean } | null = null
  #part: ImageBitmap | null = null
  /** The camera's pixel at the upper left border of the part, and pixels of the part for one of the camera. */
  #begin: Pixel = [0, 0]
  #shrunk = 1
  #centre: Pixel
  #scale: number
  #drag: { x: number; y: number; moved: boolean } | null = null

  constructor(
    readonly desk: Desk,
    readonly picture: Picture,
    readonly sight: Sight,
    readonly put: (tile: ControlTile, pixel: Pixel | null) => void,
  ) {
    const { u_px, v_px, sigma_u_px, sigma_v_px } = sight
    this.#centre = [u_px, v_px]
    this.#scale = Math.min(CLOSE, HEIGHT / 2 / Math.max(LEAST_PX, 3.5 * Math.max(sigma_u_px, sigma_v_px)))
    this.#canvas.setAttribute('aria-label', `${sight.name}. Arrow keys move it, plus and minus zoom, Enter measures what lies in the middle, Delete removes the measurement.`)
    const title = `${sight.name}: ${format.fixed(sight.distance_m, 1)} m away, ${format.fixed(1000 * sight.resolution_m, 1)} mm a pixel`
    this.element = h('figure', { class: 'control-tile', 'data-picture': sight.name, title }, this.#canvas, h('figcaption', {}, h('span', { class: 'grow' }, `${sight.name.split('/').at(-1)} · ${format.fixed(sight.distance_m, 1)} m`), this.#state, this.#again, this.#remove))
    this.#listen()
  }

  async load(): Promise<void> {
    const blob = await this.desk.source.blob(this.picture.url, this.picture.url.endsWith('.png') ? 'image/png' : 'image/jpeg')
    const whole = await createImageBitmap(blob)
    this.#shrunk = whole.width / this.picture.camera.width_px
    const half = Math.ceil((1.6 * WIDTH) / this.#scale / 2) + 24
    const [x, y] = [this.sight.u_px, this.sight.v_px].map((one) => Math.floor((one + 0.5 - half) * this.#shrunk)) as Pixel
    const side = Math.ceil(2 * half * this.#shrunk)
    this.#part = await createImageBitmap(whole, x, y, side, side)
    whole.close()
    this.#begin = [x / this.#shrunk - 0.5, y / this.#shrunk - 0.5]
    this.draw()
  }

  #listen(): void {
    const canvas = this.#canvas
    canvas.addEventListener('pointerdown', (event) => {
      this.#drag = { x: event.clientX, y: event.clientY, moved: false }
      canvas.setPointerCapture(event.pointerId)
    })
    canvas.addEventListener('pointermove', (event) => {
      const drag = this.#drag
      if (!drag) return
      const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y]
      if (!drag.moved && Math.hypot(dx, dy) < 4) return
      this.#drag = { x: event.clientX, y: event.clientY, moved: true }
      this.#shift(-dx / this.#scale, -dy / this.#scale)
    })
    canvas.addEventListener('pointerup', (event) => {
      const drag = this.#drag
      this.#drag = null
      const box = canvas.getBoundingClientRect()
      if (drag && !drag.moved) this.#choose(event.clientX - box.left, event.clientY - box.top)
    })
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault()
      const box = canvas.getBoundingClientRect()
      this.#zoom(Math.exp(-event.deltaY * 0.0015), event.clientX - box.left, event.clientY - box.top)
    }, { passive: false })
    canvas.addEventListener('keydown', (event) => this.#key(event))
  }

  #key(event: KeyboardEvent): void {
    const step = (event.shiftKey ? 0.2 : 1) * Math.max(1, 3 / this.#scale)
    const steps: Record<string, Pixel> = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] }
    if (event.key in steps) this.#shift(...steps[event.key]!)
    else if (event.key === '+' || event.key === '=') this.#zoom(1.3)
    else if (event.key === '-') this.#zoom(1 / 1.3)
    else if (event.key === 'Enter') this.#choose(WIDTH / 2, HEIGHT / 2)
    else if (event.key === 'Delete' && this.measured) this.put(this, null)
    else return
    event.preventDefault()
    event.stopPropagation()
  }

  #shift(du: number, dv: number): void {
    this.#centre = [this.#centre[0] + du, this.#centre[1] + dv]
    this.draw()
  }

  #zoom(factor: number, x = WIDTH / 2, y = HEIGHT / 2): void {
    const [u, v] = this.#pixelAt(x, y)
    this.#scale = Math.max(0.1, Math.min(40, this.#scale * factor))
    this.#centre = [u - (x - WIDTH / 2) / this.#scale, v - (y - HEIGHT / 2) / this.#scale]
    this.draw()
  }

  /** Measure a place, or look closer where it is drawn too small for that. */
  #choose(x: number, y: number): void {
    if (!this.#part || (this.unwritten && !this.unwritten.failed)) return
    if (this.#scale < FINE) {
      this.#centre = this.#pixelAt(x, y)
      this.#scale = CLOSE
      return this.draw()
    }
    const [u, v] = this.#pixelAt(x, y)
    const { width_px, height_px } = this.picture.camera
    if (u >= -0.5 && v >= -0.5 && u <= width_px - 0.5 && v <= height_px - 0.5) this.put(this, [u, v])
  }

  #pixelAt(x: number, y: number): Pixel {
    return [this.#centre[0] + (x - WIDTH / 2) / this.#scale, this.#centre[1] + (y - HEIGHT / 2) / this.#scale]
  }

  #screenOf([u, v]: Pixel): Pixel {
    return [(u - this.#centre[0]) * this.#scale + WIDTH / 2, (v - this.#centre[1]) * this.#scale + HEIGHT / 2]
  }

  draw(): void {
    const ratio = Math.min(2, window.devicePixelRatio || 1)
    const [canvas, { elsewhere, u_px, v_px, sigma_u_px, sigma_v_px }] = [this.#canvas, this.sight]
    ;[canvas.width, canvas.height] = [WIDTH * ratio, HEIGHT * ratio]
    const context = canvas.getContext('2d')!
    context.scale(ratio, ratio)
    if (this.#part) {
      context.imageSmoothingEnabled = this.#scale < FINE
      const size = (this.#part.width / this.#shrunk) * this.#scale
      context.drawImage(this.#part, ...this.#screenOf(this.#begin), size, size)
    }
    const mark = this.unwritten ? this.unwritten.pixel : this.measured
    const expected = this.#screenOf([u_px, v_px])
    stroke(context, '#ffd43b', mark ? 0.45 : 1, () => {
      context.ellipse(...expected, 3 * sigma_u_px * this.#scale, 3 * sigma_v_px * this.#scale, 0, 0, 2 * Math.PI)
      cross(context, expected, 3, 9)
    })
    if (elsewhere && !mark) stroke(context, '#74c0fc', 1, () => cross(context, this.#screenOf(elsewhere.pixel), 2, 12))
    if (mark) stroke(context, this.unwritten?.failed ? '#ff6b6b' : '#69db7c', 1, () => cross(context, this.#screenOf(mark), 2, 16))
    this.#canvas.dataset['scale'] = String(this.#scale)
    this.element.dataset['state'] = this.unwritten ? (this.unwritten.failed ? 'failed' : 'writing') : this.measured ? 'measured' : 'open'
    this.#state.textContent = this.unwritten ? (this.unwritten.failed ? 'not written' : 'writing …') : mark ? mark.map((one) => one.toFixed(2)).join(' ') : elsewhere ? elsewhere.source : ''
    this.#again.hidden = !this.unwritten?.failed
    this.#remove.hidden = !this.measured || this.unwritten !== null
  }
}

/** A cross that leaves its middle free. */
function cross(context: CanvasRenderingContext2D, [x, y]: Pixel, from: number, to: number): void {
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]] as const) {
    context.moveTo(x + dx * from, y + dy * from)
    context.lineTo(x + dx * to, y + dy * to)
  }
}

function stroke(context: CanvasRenderingContext2D, colour: string, strength: number, path: () => void): void {
  for (const [width, drawn] of [[3.5, 'rgba(0,0,0,.75)'], [1.5, colour]] as const) {
    context.beginPath()
    path()
    ;[context.lineWidth, context.strokeStyle, context.globalAlpha] = [width, drawn, strength]
    context.stroke()
  }
  context.globalAlpha = 1
}
