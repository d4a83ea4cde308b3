/** The point cloud: drawing, picking and the tools that measure in it. */

import { groundHeights } from './ground'
import { Vector3 } from 'three'
import type { Desk, Place, Target } from '../core/desk'
import { fill, h, iconButton } from '../core/dom'
import * as format from '../core/format'
import { css, ramp, SCALE_NAMES } from '../core/scales'
import { Signal } from '../core/signal'
import type { MeshIndex } from '../core/site'
import { Eye } from './camera'
import { Controls } from './controls'
import { chooseNodes } from './levels'
import type { SurfaceMeshes } from './meshes'
import { drawOverlay, type Drawing } from './overlay'
import { type Picked, pick } from './pick'
import { CloudScene, type Colouring, type Look } from './scene'
import type { CloudNode, CloudStore } from './store'

export type CloudTool = 'select' | 'distance' | 'height' | 'section' | 'profile'

export interface CloudMeasure {
  kind: Exclude<CloudTool, 'select'>
  points: [number, number, number][]
}

const FIRST_BUDGET = 700_000
const BUDGET = 3_000_000
const REACH_PX = 6
/** While points come, a picture is drawn no more often than so. */
const BETWEEN_PICTURES_MS = 300
/** After so long people are told why they wait. */
const PATIENCE_MS = 4000

export class CloudView {
  readonly element: HTMLElement
  readonly tool = new Signal<CloudTool>('select')
  readonly measured = new Signal<CloudMeasure | null>(null)
  readonly eye = new Eye()
  /** Lines and marks that other parts show in the cloud. */
  readonly drawings = new Map<string, Drawing[]>()
  readonly #canvas = h('canvas', {
    class: 'cloud-canvas',
    tabindex: 0,
    role: 'application',
    'aria-label': 'Point cloud. Arrow keys move, with Shift they turn, plus and minus come nearer and leave, Enter picks the point in the middle.',
  })
  readonly #overlay = h('canvas', { class: 'cloud-overlay', 'aria-hidden': 'true' })
  readonly #status = h('div', { class: 'cloud-status', role: 'status' })
  readonly #settings = h('div', { class: 'cloud-settings' })
  readonly #scene: CloudScene
  readonly #controls: Controls
  readonly #origin: [number, number, number]
  readonly #hiddenClasses = new Set<number>()
  readonly #hiddenPasses = new Set<number>()
  #look: Look
  /** Zero until the page has given it room. */
  #size = { width: 0, height: 0 }
  #nodes: Map<CloudNode, Float32Array> = new Map()
  #budget = FIRST_BUDGET
  #stale = true
  #asked = false
  #active = false
  /** When the first file was asked for. */
  #openedAt = 0
  #draft: [number, number, number][] = []
  #far = 60
  #meshes: Promise<SurfaceMeshes> | null = null
  #coloured = false
  /** Heights of the ground, from robust percentiles; null until points are there. */
  #ground: [number, number] | null = null
  /** True once people have spread the scale themselves. */
  #isSpread = false
  /** True once people have moved the eye. */
  #touched = false
  /** Where it looks, as long as the height of the ground there is a guess. */
  #guessed: Target | null = null
  #hover = 0
  #pause = 0

  constructor(
    readonly desk: Desk,
    readonly store: CloudStore,
  ) {
    this.#origin = desk.survey.origin_m
    this.#scene = new CloudScene(this.#canvas, this.#origin)
    const [from, to] = this.#heights()
    this.#look = { colouring: 'height', from, to, ramp: 'viridis', lighting: true, size: 1 }
    this.#controls = new Controls(this.#canvas, this.eye, {
      below: (x, y) => this.#below(x, y),
      moved: () => this.#moved(),
      size: () => this.#size,
    })
    this.element = h(
      'div',
      { class: 'cloud-view' },
      this.#canvas,
      this.#overlay,
      h(
        'div',
        { class: 'view-buttons' },
        iconButton('plus', 'Come nearer (+)', () => this.#approach(0.6)),
        iconButton('minus', 'Go back (-)', () => this.#approach(1.6)),
        iconButton('fit', 'Show the whole cloud (0)', () => this.fit()),
        iconButton('down', 'Look straight down (T)', () => this.topView()),
      ),
      this.#settings,
      this.#status,
    )
    store.arrived = () => this.#arrived()
    store.dropped = (node) => this.#scene.drop(node)
    this.#listen()
    this.#applyCodes()
    this.#drawSettings()
    this.fit()
    if (desk.target.value) this.#goTo(desk.target.value)
  }

  /** The scale of heights: those of the ground, once points are there; until then all that the survey has. */
  #heights(): [number, number] {
    return this.#ground ?? this.#allHeights()
  }

  #allHeights(): [number, number] {
    const [low, high] = [Math.min(...this.store.sheets.map((one) => one.bounds.min[2])), Math.max(...this.store.sheets.map((one) => one.bounds.max[2]))]
    return this.desk.survey.height_extent_m ?? [low, high]
  }

  #listen(): void {
    const { desk } = this
    new ResizeObserver(() => this.#resize()).observe(this.element)
    this.#canvas.addEventListener('pointerdown', () => this.#settle(), { capture: true })
    this.#canvas.addEventListener('click', (event) => {
      if (!this.#controls.dragging) this.#click(event.offsetX, event.offsetY)
    })
    this.#canvas.addEventListener('dblclick', () => this.finish())
    this.#canvas.addEventListener('pointermove', (event) => {
      if (!event.buttons) this.#point(event.offsetX, event.offsetY)
    })
    this.#canvas.addEventListener('pointerleave', () => (desk.pointer.value = null))
    this.#canvas.addEventListener('keydown', (event) => this.#key(event))
    desk.dark.on((dark) => {
      this.#scene.setEmpty(dark ? [20, 22, 26] : [238, 240, 243])
      this.#redraw()
    }, true)
    desk.target.on((goal) => goal && this.#goTo(goal))
    desk.place.on(() => this.#redraw())
    this.tool.on(() => {
      this.#draft = []
      this.#canvas.style.cursor = this.tool.value === 'select' ? '' : 'crosshair'
      this.#redraw()
    })
  }

  /** Look at a place; without its height, at the ground there, once more when the points are here that tell it. */
  #goTo(goal: Target): void {
    const height = goal.height_m ?? this.groundAt(goal.easting_m, goal.northing_m)
    this.#far = Math.max(2, goal.across_m ?? 15)
    this.eye.lookAt(this.#local([goal.easting_m, goal.northing_m, height]), this.#far)
    this.#moved()
    this.#guessed = goal.height_m === undefined || goal.height_m === null ? goal : null
  }

  #key(event: KeyboardEvent): void {
    if (event.key === 'Enter') this.#enter()
    else if (event.key === 't' || event.key === 'T') this.topView()
    else if (event.key === '0') this.fit()
    else return
    event.preventDefault()
    event.stopPropagation()
  }

  /** Draw only while the view can be seen. */
  set active(active: boolean) {
    this.#active = active
    if (active) this.#redraw(true)
  }

  #local([easting, northing, height]: readonly number[]): Vector3 {
    return new Vector3(easting! - this.#origin[0], northing! - this.#origin[1], height! - this.#origin[2])
  }

  /** Make the picture as large as its room, which may have changed since the last one: a press means what is seen now. */
  #settle(): void {
    const { clientWidth: width, clientHeight: height } = this.element
    if (width === this.#size.width && height === this.#size.height) return
    this.#resize()
    this.#draw()
  }

  #resize(): void {
    const { clientWidth: width, clientHeight: height } = this.element
    if (!width || !height) return
    this.#size = { width, height }
    this.#scene.resize(width, height)
    const ratio = Math.min(2, window.devicePixelRatio || 1)
    ;[this.#overlay.width, this.#overlay.height] = [width * ratio, height * ratio]
    this.#applyLook()
    if (!this.#touched) this.fit()
    this.#redraw(true)
  }

  #moved(): void {
    this.#touched = true
    this.#guessed = null
    this.#budget = BUDGET
    if (this.#meshes) void this.#meshes.then((meshes) => this.#lookForMeshes(meshes))
    this.#redraw(true)
  }

  #redraw(choose = false): void {
    this.#stale ||= choose
    if (choose && this.#active) this.element.dataset['loading'] = 'waiting'
    if (this.#asked || !this.#active || !this.#size.width) return
    this.#asked = true
    requestAnimationFrame(() => {
      this.#asked = false
      this.#draw()
    })
  }

  #draw(): void {
    const { width, height } = this.#size
    this.eye.apply(width, height, this.#far * 0.04, this.#farthest())
    const focal = this.eye.focal(height)
    if (this.#stale) {
      this.#stale = false
      this.store.turn++
      const { nodes, points } = chooseNodes(this.store, this.eye.camera, this.eye.place, focal, this.#origin, this.#budget)
      this.store.cancelBefore(this.store.turn)
      this.#nodes = nodes
      this.#scene.show(nodes, this.#look.size)
      this.#tell(points)
    }
    this.#scene.render(this.eye.camera, focal)
    this.#drawMarks()
  }

  #farthest(): number {
    const { min, max } = this.#extent()
    const corner = new Vector3(...[0, 1, 2].map((axis) => Math.max(Math.abs(min[axis]! - this.eye.place.getComponent(axis)), Math.abs(max[axis]! - this.eye.place.getComponent(axis)))))
    return Math.min(20_000, corner.length())
  }

  #extent(): { min: number[]; max: number[] } {
    const [min, max] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]]
    for (const { bounds } of this.store.sheets) {
      for (let axis = 0; axis < 3; axis++) {
        min[axis] = Math.min(min[axis]!, bounds.min[axis]! - this.#origin[axis]!)
        max[axis] = Math.max(max[axis]!, bounds.max[axis]! - this.#origin[axis]!)
      }
    }
    return { min, max }
  }

  #tell(points: number): void {
    const loading = this.store.loading
    const opening = this.store.sheets.some((sheet) => sheet.open && !sheet.copc)
    if (opening && !this.#openedAt) {
      this.#openedAt = performance.now()
      window.setTimeout(() => this.#redraw(true), PATIENCE_MS + 100)
    }
    const isSlow = performance.now() - this.#openedAt > PATIENCE_MS
    const waiting = isSlow ? 'Opening the cloud … roadscan view makes its file the first time, which may take a minute.' : 'Opening the cloud …'
    this.#status.textContent = opening ? waiting : `${format.fixed(points / 1e6, 2)} million points${loading ? ', loading …' : ''}`
    this.element.dataset['loading'] = String(loading + Number(opening))
  }

  #drawMarks(): void {
    const drawings: Drawing[] = [...this.drawings.values()].flat()
    const { place } = this.desk
    if (place.value && place.value.height_m !== null) {
      drawings.push({ kind: 'cross', points: [[place.value.easting_m, place.value.northing_m, place.value.height_m]] })
    }
    if (this.#draft.length) drawings.push({ kind: 'line', points: this.#draft, dots: true })
    drawOverlay(this.#overlay, this.#size, this.eye.camera, this.#origin, drawings, this.desk.dark.value)
  }

  /** Something came: many nodes come at once, and not each is worth a picture of its own. */
  #arrived(): void {
    if (!this.#coloured && this.store.coloured) {
      this.#coloured = true
      this.#drawSettings()
    }
    if (!this.store.loading && this.#guessed) {
      this.#findGround()
      this.#goTo(this.#guessed)
      this.#guessed = null
    } else if (!this.store.loading) {
      this.#findGround()
      this.#redraw(true)
    }
    else this.#pause ||= window.setTimeout(() => {
      this.#pause = 0
      this.#redraw(true)
    }, BETWEEN_PICTURES_MS)
  }

  /** Show the meshes of the detailed surface, or the points alone. */
  async showMeshes(shown: boolean): Promise<void> {
    const { survey, source } = this.desk
    this.#meshes ??= (async () => {
      const [{ SurfaceMeshes }, index] = await Promise.all([import('./meshes'), source.json<MeshIndex>(survey.meshes!.url)])
      const arrived = (): void => {
        this.element.dataset['meshes'] = String(this.#scene.meshes.children.length)
        this.#redraw()
      }
      return new SurfaceMeshes(index, source, this.#scene.meshes, this.#origin, arrived, (error) => this.desk.complain(error))
    })()
    const meshes = await this.#meshes
    meshes.shown = shown
    this.#lookForMeshes(meshes)
    this.#redraw()
  }

  #lookForMeshes(meshes: SurfaceMeshes): void {
    const at = this.eye.place.clone().addScaledVector(this.eye.direction(), Math.min(this.#far, 200))
    meshes.look(at.x + this.#origin[0], at.y + this.#origin[1])
  }

  // ---- where things are ----

  #shown = (node: CloudNode, index: number): boolean => {
    const { points } = node
    if (this.#look.colouring === 'class') return !this.#hiddenClasses.has(points!.classes[index]!)
    if (this.#look.colouring === 'pass') return !this.#hiddenPasses.has(points!.pass[index]!)
    return true
  }

  pickAt(x: number, y: number, reach_px = REACH_PX): Picked | null {
    return pick(this.store, this.#nodes.keys(), this.eye.camera, this.#origin, { ...this.#size, x, y }, reach_px, this.#shown)
  }

  /** The pixel at which a place of the map is seen; null behind the eye. */
  pixelOf(coordinate: readonly [number, number, number]): [number, number] | null {
    const seen = this.#local(coordinate).project(this.eye.camera)
    if (seen.z > 1) return null
    return [((seen.x + 1) / 2) * this.#size.width, ((1 - seen.y) / 2) * this.#size.height]
  }

  #below(x: number, y: number): Vector3 {
    const { width, height } = this.#size
    const picked = this.pickAt(x, y, 14)
    const ray = this.eye.ray(x, y, width, height)
    if (picked) {
      // The near plane follows, so other nodes may come into sight.
      this.#far = this.#local(picked.coordinate).distanceTo(this.eye.place)
      this.#redraw(true)
    }
    return picked ? this.#local(picked.coordinate) : this.eye.place.clone().addScaledVector(ray, this.#far)
  }

  /** Height (m) of the loaded point that lies nearest to a place of the map. */
  groundAt(easting_m: number, northing_m: number): number {
    let [least, height] = [Infinity, this.#allHeights()[0]]
    for (const node of this.store.ready()) {
      if (node.depth > 4) continue
      const { box, points, origin } = node
      const [dx, dy] = [Math.max(box.min[0] - easting_m, 0, easting_m - box.max[0]), Math.max(box.min[1] - northing_m, 0, northing_m - box.max[1])]
      if (dx * dx + dy * dy > least) continue
      const { position, count } = points!
      for (let index = 0, at = 0; index < count; index++, at += 3) {
        const apart = (position[at]! + origin[0] - easting_m) ** 2 + (position[at + 1]! + origin[1] - northing_m) ** 2
        if (apart < least) [least, height] = [apart, position[at + 2]! + origin[2]]
      }
    }
    return height
  }

  fit(): void {
    const { min, max } = this.#extent()
    const middle = new Vector3(...[0, 1, 2].map((axis) => (min[axis]! + max[axis]!) / 2))
    this.eye.heading = 0
    this.eye.tilt = 0.75
    const [ahead, right] = [this.eye.direction(), this.eye.right()]
    const up = new Vector3().crossVectors(right, ahead)
    const high = Math.tan((this.eye.camera.fov * Math.PI) / 360)
    const wide = high * (this.#size.width / this.#size.height || 1)
    // Each corner of the cloud's box is to be within the picture.
    let far = 5
    for (let corner = 0; corner < 8; corner++) {
      const by = new Vector3(...[0, 1, 2].map((axis) => ((corner >> axis) & 1 ? max[axis]! : min[axis]!))).sub(middle)
      far = Math.max(far, 1.05 * Math.max(Math.abs(by.dot(right)) / wide, Math.abs(by.dot(up)) / high) - by.dot(ahead))
    }
    this.#far = far
    this.eye.lookAt(middle, far)
    this.#redraw(true)
  }

  topView(): void {
    const middle = this.#below(this.#size.width / 2, this.#size.height / 2)
    const distance = middle.distanceTo(this.eye.place)
    this.eye.heading = 0
    this.eye.tilt = Math.PI / 2 - 1e-3
    this.eye.lookAt(middle, distance)
    this.#moved()
  }

  #approach(factor: number): void {
    this.eye.approach(this.#below(this.#size.width / 2, this.#size.height / 2), factor)
    this.#moved()
  }

  // ---- pointing ----

  #describe({ node, index, coordinate }: Picked): Place {
    const points = node.points!
    const { classes, passes } = this.store.index
    const code = points.classes[index]!
    const pass = points.pass[index]!
    return {
      easting_m: coordinate[0],
      northing_m: coordinate[1],
      height_m: coordinate[2],
      from: 'cloud',
      notes: [
        ['Intensity', String(points.intensity[index])],
        ['Class', classes.find((one) => one.class === code)?.title ?? String(code)],
        ['Pass', passes.find((one) => one.pass === pass)?.title ?? String(pass)],
      ],
    }
  }

  #point(x: number, y: number): void {
    const now = performance.now()
    if (now - this.#hover < 70) return
    this.#hover = now
    const picked = this.pickAt(x, y)
    this.desk.pointer.value = picked ? this.#describe(picked) : null
    this.#hover = performance.now()
  }

  #click(x: number, y: number): void {
    const picked = this.pickAt(x, y)
    if (!picked) {
      this.desk.say('There is no point below the pointer.')
      return
    }
    const tool = this.tool.value
    if (tool === 'select') {
      this.desk.place.value = this.#describe(picked)
      return
    }
    this.#draft.push(picked.coordinate)
    if (tool !== 'distance' && tool !== 'profile' && this.#draft.length === 2) this.finish()
    this.#redraw()
  }

  /** Take the point in the middle; one that was taken last ends the line. */
  #enter(): void {
    const [x, y] = [this.#size.width / 2, this.#size.height / 2]
    const last = this.#draft.at(-1)
    if (last && this.#draft.length > 1 && this.pickAt(x, y)?.coordinate.every((value, axis) => value === last[axis])) this.finish()
    else this.#click(x, y)
  }

  /** End the line that is being measured. */
  finish(): void {
    const tool = this.tool.value
    const points = this.#draft.filter((one, index) => index === 0 || one.some((value, axis) => value !== this.#draft[index - 1]![axis]))
    this.#draft = []
    if (tool !== 'select' && points.length > 1) this.measured.value = { kind: tool, points }
    this.#redraw()
  }

  abort(): void {
    this.#draft = []
    this.#redraw()
  }

  setDrawings(name: string, drawings: Drawing[]): void {
    this.drawings.set(name, drawings)
    this.#redraw()
  }

  // ---- colours ----

  #applyLook(): void {
    this.#scene.setLook(this.#look)
    this.#scene.show(this.#nodes, this.#look.size)
    this.#redraw()
  }

  #applyCodes(): void {
    const { classes, passes } = this.store.index
    this.#scene.setCodes(
      classes.map((one) => ({ code: one.class, colour: one.colour, shown: !this.#hiddenClasses.has(one.class) })),
      passes.map((one) => ({ code: one.pass, colour: one.colour, shown: !this.#hiddenPasses.has(one.pass) })),
    )
    this.#redraw()
  }

  setColouring(colouring: Colouring): void {
    const [from, to] = colouring === 'intensity' ? (this.store.index.intensity ?? [0, 65535]) : this.#heights()
    this.#look = { ...this.#look, colouring, from, to, ramp: colouring === 'intensity' ? 'grey' : 'viridis' }
    this.#applyLook()
    this.#drawSettings()
  }

  /** Let the scale show the ground, whatever stands on it: houses would leave the road one colour. Done once. */
  #findGround(): void {
    if (this.#ground) return
    this.#ground = groundHeights([...this.store.ready()])
    if (!this.#ground) return
    const [from, to] = this.#ground
    this.element.dataset['ground'] = `${from.toFixed(3)},${to.toFixed(3)}`
    if (this.#look.colouring !== 'height' || this.#isSpread) return
    this.#look = { ...this.#look, from, to }
    this.#applyLook()
    this.#drawSettings()
  }

  /** Spread the scale over what is seen now: from the 2nd to the 98th percentile of the drawn points. */
  spread(): void {
    const values: number[] = []
    const { width, height } = this.#size
    for (const node of this.#nodes.keys()) {
      const { position, intensity, count } = node.points!
      const step = Math.max(1, Math.floor(count / 2000))
      for (let index = 0; index < count; index += step) {
        const at = [0, 1, 2].map((axis) => position[index * 3 + axis]! + node.origin[axis]!) as [number, number, number]
        const pixel = this.pixelOf(at)
        if (!pixel || pixel[0] < 0 || pixel[1] < 0 || pixel[0] > width || pixel[1] > height) continue
        values.push(this.#look.colouring === 'intensity' ? intensity[index]! : at[2])
      }
    }
    if (values.length < 10) return
    values.sort((a, b) => a - b)
    const [from, to] = [values[Math.floor(values.length * 0.02)]!, values[Math.floor(values.length * 0.98)]!]
    this.#isSpread = true
    this.#look = { ...this.#look, from, to: Math.max(to, from + 1e-3) }
    this.#applyLook()
    this.#drawSettings()
  }

  #drawSettings(): void {
    const { colours } = this.store.index
    const titles: Record<string, string> = { height: 'Height', intensity: 'Intensity', class: 'Class', pass: 'Pass', rgb: 'Pictures' }
    const offered = [...new Set([...colours, ...(this.store.coloured ? ['rgb'] : [])])].filter((one) => one in titles)
    const select = h(
      'select',
      { 'aria-label': 'Colour by', onchange: (event: Event) => this.setColouring((event.target as HTMLSelectElement).value as Colouring) },
      ...offered.map((one) => h('option', { value: one, selected: one === this.#look.colouring }, titles[one])),
    )
    fill(this.#settings, h('div', { class: 'row' }, select, this.#lightingBox()), this.#legend(), this.#sizeSlider(), this.desk.survey.meshes ? this.#meshBox() : null)
  }

  #lightingBox(): HTMLElement {
    const box = h('input', { type: 'checkbox', checked: this.#look.lighting, onchange: () => this.#change({ lighting: box.checked }) })
    return h('label', { class: 'check', title: 'Eye-dome lighting: edges stand out by their depth' }, box, 'Shading')
  }

  #meshBox(): HTMLElement {
    const box = h('input', { type: 'checkbox', checked: this.#meshShown, onchange: () => {
      this.#meshShown = box.checked
      this.showMeshes(box.checked).catch((error) => this.desk.complain(error))
    } })
    return h('label', { class: 'check' }, box, 'Mesh of the surface')
  }

  #meshShown = false

  #sizeSlider(): HTMLElement {
    const slider = h('input', { type: 'range', min: 0.4, max: 3, step: 0.1, value: this.#look.size, 'aria-label': 'Size of points', oninput: () => this.#change({ size: Number(slider.value) }) })
    return h('label', { class: 'slider' }, 'Size', slider)
  }

  #change(part: Partial<Look>): void {
    this.#look = { ...this.#look, ...part }
    this.#applyLook()
  }

  #legend(): HTMLElement {
    const { colouring, from, to } = this.#look
    const { classes, passes } = this.store.index
    if (colouring === 'class') return this.#codes(classes.map((one) => ({ code: one.class, ...one })), this.#hiddenClasses)
    if (colouring === 'pass') return this.#codes(passes.map((one) => ({ code: one.pass, ...one })), this.#hiddenPasses)
    if (colouring === 'rgb') return h('div', {})
    const digits = colouring === 'height' ? 2 : 0
    const select = h(
      'select',
      { 'aria-label': 'Colour scale', onchange: () => { this.#change({ ramp: select.value }); this.#drawSettings() } },
      ...SCALE_NAMES.map((name) => h('option', { value: name, selected: name === this.#look.ramp }, name)),
    )
    return h(
      'div',
      { class: 'ramp' },
      ramp(this.#look.ramp, 160, 8),
      h('div', { class: 'ramp-ends' }, h('span', {}, format.fixed(from, digits)), h('span', {}, colouring === 'height' ? `${format.fixed(to, digits)} m` : format.fixed(to, digits))),
      h('div', { class: 'row' }, select, h('button', { type: 'button', title: 'Spread the scale over what is seen', onclick: () => this.spread() }, 'Spread')),
    )
  }

  #codes(list: { code: number; title: string; colour: string }[], hidden: Set<number>): HTMLElement {
    return h(
      'ul',
      { class: 'codes' },
      ...list.map(({ code, title, colour }) => {
        const box = h('input', {
          type: 'checkbox',
          checked: !hidden.has(code),
          onchange: () => {
            if (box.checked) hidden.delete(code)
            else hidden.add(code)
            this.#applyCodes()
          },
        })
        const swatch = h('span', { class: 'swatch' })
        swatch.style.background = css(colour)
        return h('li', {}, h('label', { class: 'check' }, box, swatch, h('span', {}, title)))
      }),
    )
  }
}
