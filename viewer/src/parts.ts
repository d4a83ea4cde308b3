/** Cloud, strips, sections and pictures: loaded when they are first shown, and linked with one another. */

import Feature from 'ol/Feature'
import Point from 'ol/geom/Point'
import VectorLayer from 'ol/layer/Vector'
import VectorSource from 'ol/source/Vector'
import CircleStyle from 'ol/style/Circle'
import OlFill from 'ol/style/Fill'
import OlStroke from 'ol/style/Stroke'
import OlStyle from 'ol/style/Style'
import type { CloudMeasure, CloudTool, CloudView } from './cloud/view'
import type { CloudStore } from './cloud/store'
import type { Desk, Place, ViewName } from './core/desk'
import { fill, h, iconButton } from './core/dom'
import * as format from './core/format'
import type { CloudIndex, CrossSection, PictureIndex, StripIndex, StripLane } from './core/site'
import type { MapView } from './map/map'
import type { MapTool, Measured } from './map/measure'
import { type Measurements, spaceFigures } from './panels/measurements'
import type { Picture, PictureList } from './pictures/list'
import type { ControlPanel } from './pictures/control'
import type { PictureTool, PictureView } from './pictures/view'
import { SectionPanel } from './strips/section'
import { Strips } from './strips/strips'

const MAP_TOOLS: [MapTool, Parameters<typeof iconButton>[0], string][] = [
  ['select', 'target', 'Select'],
  ['distance', 'ruler', 'Distance'],
  ['area', 'area', 'Area'],
  ['section', 'section', 'Section through the cloud'],
]

const CLOUD_TOOLS: [CloudTool, Parameters<typeof iconButton>[0], string][] = [
  ['select', 'target', 'Read a point'],
  ['distance', 'ruler', 'Distance'],
  ['height', 'height', 'Height difference'],
  ['section', 'section', 'Cross-section'],
  ['profile', 'profile', 'Profile along a line'],
]

const PICTURE_TOOLS: [PictureTool, Parameters<typeof iconButton>[0], string][] = [
  ['select', 'target', 'Read a place'],
  ['line', 'ruler', 'Line on the ground'],
  ['stereo', 'cube', 'Place by two pictures'],
  ['control', 'point', 'Control points in pictures'],
]

/** The pictures, and what measures in them where a server answers. */
interface Pictures {
  list: PictureList
  view: PictureView
  control: ControlPanel | null
  tools: HTMLElement | null
}

export class ModelParts {
  readonly section: SectionPanel
  readonly tip = h('span', { class: 'tip' })
  #store: Promise<CloudStore | null> | null = null
  #cloud: Promise<CloudView> | null = null
  #view: CloudView | null = null
  #strips: Promise<Strips> | null = null
  #pictures: Promise<Pictures> | null = null
  #abortPictures: () => boolean = () => false
  #active: ReadonlySet<ViewName> = new Set()

  constructor(
    readonly desk: Desk,
    readonly map: MapView,
    readonly measurements: Measurements,
    readonly openSection: () => void,
    /** Null where this address allows no edits. */
    readonly token: string | null = null,
  ) {
    this.section = new SectionPanel(desk)
    this.section.pointed = (place) => this.#view?.setDrawings('section-cursor', [{ kind: 'ring', points: [place] }])
    map.measured.on((done) => done && this.#mapMeasured(done.measured, done.remove))
    desk.place.on((place) => place && void this.#stationOf(place))
    desk.station.on((station) => {
      if (station && this.#strips) void this.#strips.then((strips) => this.#markStation(strips))
    })
    desk.selected.on((selected) => this.#outline(selected?.feature.geometry ?? null))
  }

  // ---- tools ----

  mapTools(): HTMLElement {
    const tools = MAP_TOOLS.filter(([name]) => name !== 'section' || this.desk.survey.clouds)
    return this.#toolbar('Tools of the map', tools, this.map.tool, (tool) => {
      const tips: Record<MapTool, string> = {
        select: '',
        distance: 'Click the corners of the line; a double click ends it.',
        area: 'Click the corners of the area; a double click ends it.',
        section: 'Click both ends of the section.',
      }
      this.tip.textContent = tips[tool]
    })
  }

  #toolbar<T extends string>(label: string, tools: [T, Parameters<typeof iconButton>[0], string][], chosen: { value: T; on: (f: (tool: T) => void, now?: boolean) => unknown }, tell: (tool: T) => void): HTMLElement {
    const bar = h('div', { class: 'toolbar', role: 'toolbar', 'aria-label': label })
    for (const [name, drawn, title] of tools) {
      const button = iconButton(drawn, title, () => (chosen.value = name))
      chosen.on((now) => button.setAttribute('aria-pressed', String(now === name)), true)
      bar.append(button)
    }
    chosen.on(tell)
    return bar
  }

  /** Give up what is being measured; false where nothing was. */
  abort(): boolean {
    const busy = this.map.tool.value !== 'select' || (this.#view !== null && this.#view.tool.value !== 'select')
    const drawing = this.#abortPictures()
    this.map.measuring.abort()
    this.map.tool.value = 'select'
    if (this.#view) {
      this.#view.abort()
      this.#view.tool.value = 'select'
    }
    return busy || drawing
  }

  #mapMeasured(measured: Measured, remove: () => void): void {
    const { kind, points, length_m, area_m2 } = measured
    if (kind === 'section') {
      remove()
      void this.#showSection('Section', points)
      return
    }
    const lines: [string, string][] = [[kind === 'area' ? 'Perimeter' : 'Length', format.metres(kind === 'area' ? ringLength(points) : length_m, 4)]]
    if (area_m2 !== null) lines.unshift(['Area', `${format.fixed(area_m2, 4)}\u202fm²`])
    if (kind === 'distance' && points.length === 2) {
      const [de, dn] = [points[1]![0] - points[0]![0], points[1]![1] - points[0]![1]]
      lines.push(['Azimuth', `${format.fixed(((Math.atan2(de, dn) * 180) / Math.PI + 360) % 360, 3)}°`])
    }
    this.measurements.add({ title: kind === 'area' ? 'Area on the map' : 'Distance on the map', lines, points, remove })
  }

  #cloudMeasured(measure: CloudMeasure): void {
    const { kind, points } = measure
    const view = this.#view!
    if (kind === 'section' || kind === 'profile') {
      const title = kind === 'section' ? 'Cross-section' : 'Profile'
      void this.#showSection(title, points.map(([e, n]) => [e, n] as const))
    }
    const lines = spaceFigures(points)
    const name = `measure-${performance.now()}`
    const label = kind === 'height' ? `Δ ${format.length(points[1]![2] - points[0]![2])}` : lines.find(([one]) => one === 'Along the line')?.[1] ?? lines[0]![1]
    view.setDrawings(name, [{ kind: 'line', points, dots: true, label }])
    const titles = { distance: 'Distance', height: 'Height difference', section: 'Cross-section', profile: 'Profile' }
    this.measurements.add({ title: titles[kind], lines: kind === 'height' ? [lines.find(([one]) => one === 'Height difference')!, ...lines.filter(([one]) => one !== 'Height difference')] : lines, points, remove: () => view.setDrawings(name, []) })
  }

  // ---- the cloud ----

  #openStore(): Promise<CloudStore | null> {
    const { survey, source } = this.desk
    if (!survey.clouds) return Promise.resolve(null)
    this.#store ??= (async () => {
      const [{ CloudStore }, index] = await Promise.all([import('./cloud/store'), source.json<CloudIndex>(survey.clouds!.url)])
      return new CloudStore(index, survey, source, (error) => this.desk.complain(error))
    })()
    return this.#store
  }

  /** Fetch the code and the coarsest points before the view is there: its graphics take a while to begin. */
  prepareCloud(): void {
    void import('./cloud/view').catch(() => {})
    void this.#openStore().then((store) => store?.begin(), () => {})
  }

  async openCloud(into: HTMLElement): Promise<void> {
    if (this.#cloud) return
    fill(into, h('p', { class: 'waiting', role: 'status' }, 'Opening the cloud …'))
    this.#cloud = (async () => {
      const [{ CloudView }, store] = await Promise.all([import('./cloud/view'), this.#openStore()])
      return new CloudView(this.desk, store!)
    })()
    try {
      const view = await this.#cloud
      this.#view = view
      view.measured.on((done) => done && this.#cloudMeasured(done))
      const tips: Record<CloudTool, string> = {
        select: '',
        distance: 'Click points; a double click ends the line.',
        height: 'Click two points.',
        section: 'Click both ends of the section.',
        profile: 'Click points along the line; a double click ends it.',
      }
      fill(into, view.element, this.#toolbar('Tools of the cloud', CLOUD_TOOLS, view.tool, (tool) => (this.tip.textContent = tips[tool])))
      view.active = this.#active.has('cloud')
      this.#outline(this.desk.selected.value?.feature.geometry ?? null)
    } catch (error) {
      this.#cloud = null
      fill(into, h('p', { class: 'waiting', role: 'alert' }, `The cloud could not be shown: ${error instanceof Error ? error.message : String(error)}`))
    }
  }

  /** Fetch the code of all parts, so that they work when the host is gone. */
  async fetchCode(): Promise<void> {
    const { survey } = this.desk
    const code = [...(survey.clouds ? [import('./cloud/store'), import('./cloud/view'), import('./cloud/slice')] : []), ...(survey.pictures ? [import('./pictures/list'), import('./pictures/view')] : []), ...(survey.measuring ? [import('./pictures/measuring'), import('./pictures/control')] : [])]
    await Promise.allSettled(code)
  }

  setActive(views: ReadonlySet<ViewName>): void {
    this.#active = views
    if (this.#view) this.#view.active = views.has('cloud')
  }

  /** The selected feature in the cloud; where it has no heights, on the ground as far as it is loaded. */
  #outline(geometry: { type: string; coordinates: any } | null): void {
    const view = this.#view
    if (!view) return
    const lines: number[][][] = []
    const collect = (coordinates: any): void => {
      if (typeof coordinates?.[0] === 'number') lines.push([coordinates])
      else if (typeof coordinates?.[0]?.[0] === 'number') lines.push(coordinates)
      else for (const one of coordinates ?? []) collect(one)
    }
    if (geometry) collect(geometry.coordinates)
    const raised = lines.map((line) => line.map(([e, n, z]) => [e!, n!, z ?? view.groundAt(e!, n!)] as [number, number, number]))
    view.setDrawings('selected', raised.slice(0, 200).map((points) => (points.length === 1 ? { kind: 'ring' as const, points } : { kind: 'line' as const, points })))
  }

  async #showSection(title: string, line: readonly (readonly [number, number])[], begin_m = 0, curve: Parameters<SectionPanel['show']>[0]['curve'] = null): Promise<void> {
    this.openSection()
    try {
      const store = await this.#openStore()
      if (!store) throw new Error('this site holds no point cloud, so there is no section through it')
      const { sliceAlong } = await import('./cloud/slice')
      const length = ringLength(line) - (line.length > 2 ? Math.hypot(line[0]![0] - line.at(-1)![0], line[0]![1] - line.at(-1)![1]) : 0)
      const bin_m = curve ? 0.005 : Math.max(this.desk.survey.cell_m, length / 1500)
      await this.section.show({ title, begin_m, curve, slice: (half) => sliceAlong(store, line, half, bin_m) })
    } catch (error) {
      this.desk.complain(error)
    }
  }

  // ---- strips ----

  #openStripsOnce(): Promise<Strips> {
    const { survey, source } = this.desk
    this.#strips ??= (async () => {
      const index = await source.json<StripIndex>(survey.strips!.url)
      const strips = new Strips(this.desk, index, (lane, section) => this.#crossSection(lane, section))
      await strips.open(index.lanes[0]!.lane_id)
      return strips
    })()
    return this.#strips
  }

  async openStrips(into: HTMLElement): Promise<void> {
    fill(into, h('p', { class: 'waiting', role: 'status' }, 'Opening the strips …'))
    try {
      const strips = await this.#openStripsOnce()
      fill(into, strips.element)
    } catch (error) {
      this.desk.complain(error)
    }
  }

  #markStation(strips: Strips): void {
    const { station } = this.desk
    const place = station.value && strips.placeAt(station.value)
    this.map.markStation(place ? [place.easting_m, place.northing_m] : null)
    if (!this.#view) return
    const height = place ? this.#view.groundAt(place.easting_m, place.northing_m) : 0
    this.#view.setDrawings('station', place ? [{ kind: 'ring', points: [[place.easting_m, place.northing_m, height]] }] : [])
  }

  async #stationOf(place: Place): Promise<void> {
    if (!this.#strips || place.from === 'search') return
    const strips = await this.#strips
    const station = await strips.stationOf(place.easting_m, place.northing_m)
    if (station) await strips.goTo(station)
  }

  async goToStation(station_m: number, lane_id: number | null): Promise<void> {
    const strips = await this.#openStripsOnce()
    const station = { lane_id: lane_id ?? strips.lane.lane_id, station_m }
    await strips.goTo(station)
    const place = strips.placeAt(station)
    if (place) this.desk.goTo({ ...place, across_m: 30 })
  }

  /** Go to a station of a road (null: of the open lane's), in a lane of it where one is named as all products name it. */
  async goToStationOf(road: string | null, lane: string | null, station_m: number): Promise<void> {
    try {
      const strips = await this.#openStripsOnce()
      const { lanes } = strips.index
      const wanted = road ?? strips.lane.road
      const own = lanes.filter((one) => one.road === wanted)
      const known = own.find((one) => one.lane === lane) ?? (road === null ? lanes.find((one) => one.lane === lane) : undefined)
      // Links of older pages counted lanes from 0: that number is meant where no lane is called so.
      const older = lane !== null && !known ? lanes.find((one) => String(one.lane_id) === lane) : undefined
      const found = known ?? older ?? (lane === null && road === null ? strips.lane : own[0])
      if (!found) return this.desk.say(`The road ${wanted} has no strips.`)
      if (older) this.desk.say(`No lane is called ${lane}: taken for the number ${lane} of an older link, lane ${older.lane} of ${older.road}.`)
      else if (lane !== null && !known) this.desk.say(`The road ${wanted} has no lane ${lane}: lane ${found.lane} is shown.`)
      await this.goToStation(station_m, found.lane_id)
    } catch (error) {
      this.desk.complain(error)
    }
  }

  /** A cross-section of the tables beside the cloud along the same line. */
  #crossSection(lane: StripLane, section: CrossSection): void {
    if (section.direction_deg === null) {
      this.desk.say('The direction of travel is not known there.')
      return
    }
    const right = ((section.direction_deg + 90) * Math.PI) / 180
    const [ue, un] = [Math.sin(right), Math.cos(right)]
    const count = section.relative_height_mm.length
    const ends = [section.first_m - section.step_m / 2, section.first_m + (count - 0.5) * section.step_m]
    const line = ends.map((offset) => [section.easting_m + ue * offset, section.northing_m + un * offset] as const)
    const station_m = section.relative_height_mm.map((_, index) => section.first_m + index * section.step_m)
    const height_m = section.relative_height_mm.map((one) => (one === null ? null : section.height_m + one / 1000))
    void this.#showSection(`Cross-section at ${format.fixed(section.station_m, 2)} m, lane ${lane.lane}`, line, ends[0]!, { title: 'table', station_m, height_m })
  }

  // ---- pictures ----

  #openPicturesOnce(): Promise<Pictures> {
    const { survey, source } = this.desk
    this.#pictures ??= (async () => {
      const [{ PictureList }, { PictureView }, index] = await Promise.all([import('./pictures/list'), import('./pictures/view'), source.json<PictureIndex>(survey.pictures!.url)])
      const list = new PictureList(index, source)
      const view = new PictureView(this.desk, list, () => this.#openStore())
      return { list, view, ...(await this.#measuringIn(list, view)) }
    })()
    return this.#pictures
  }

  get takesControl(): boolean {
    return Boolean(this.desk.survey.measuring?.control && this.token)
  }

  /** The tools that the server of `roadscan view` answers; none in a site that was published. */
  async #measuringIn(list: PictureList, view: PictureView): Promise<Pick<Pictures, 'control' | 'tools'>> {
    const rules = this.desk.survey.measuring
    if (!rules) return { control: null, tools: null }
    const [{ PictureMeasuring }, { ControlPanel }] = await Promise.all([import('./pictures/measuring'), import('./pictures/control')])
    const measuring = new PictureMeasuring(this.desk, this.map, this.measurements, view, list, rules.measure, (text) => (this.tip.textContent = text))
    const control = rules.control && this.token ? new ControlPanel(this.desk, list, rules.control, this.token) : null
    view.clicked = (picture, u, v) => measuring.clicked(picture, [u, v])
    view.ended = () => void measuring.end()
    this.#abortPictures = () => {
      const busy = view.tool.value !== 'select'
      view.tool.value = 'select'
      return busy
    }
    const tips: Record<PictureTool, string> = {
      select: '',
      line: 'Click the corners of the line on the ground; a double click ends it.',
      stereo: 'Click a thing in this picture, then the same thing in another one.',
      control: '',
    }
    const tools = this.#toolbar('Tools of the pictures', PICTURE_TOOLS.filter(([name]) => name !== 'control' || control), view.tool, (tool) => {
      this.tip.textContent = tips[tool]
      if (!control) return
      if (tool === 'control') void control.open()
      else control.element.hidden = true
    })
    return { control, tools }
  }

  /** Measure a control point in pictures. */
  async measureControl(point: string): Promise<void> {
    this.desk.show('pictures')
    try {
      const { view, control } = await this.#openPicturesOnce()
      view.tool.value = 'control'
      await control?.open(point)
    } catch (error) {
      this.desk.complain(error)
    }
  }

  /** Show on the map where pictures were taken. */
  startPictures(): void {
    if (!this.desk.survey.pictures) return
    const source = new VectorSource()
    const layer = new VectorLayer({ source, zIndex: 4000, maxResolution: 0.6 })
    this.desk.dark.on((dark) => layer.setStyle(new OlStyle({ image: new CircleStyle({ radius: 3, fill: new OlFill({ color: dark ? '#9ad1f2' : '#364fc7' }), stroke: new OlStroke({ color: dark ? '#101216' : '#fff', width: 1 }) }) })), true)
    this.map.map.addLayer(layer)
    const load = async (): Promise<void> => {
      if ((this.map.map.getView().getResolution() ?? 9) > 0.6 || source.getFeatures().length) return
      const { list } = await this.#openPicturesOnce()
      const [e, n] = this.map.seen.centre
      const pictures = await list.near(e, n, 1500)
      if (!source.getFeatures().length) source.addFeatures(pictures.map((one: Picture) => new Feature({ geometry: new Point([one.easting_m, one.northing_m]), picture: one })))
    }
    this.map.map.on('moveend', () => load().catch((error) => this.desk.complain(error)))
  }

  async openPictures(into: HTMLElement): Promise<void> {
    try {
      const { view, control, tools } = await this.#openPicturesOnce()
      if (view.element.parentElement !== into) fill(into, view.element, control?.element, tools)
      await view.openFirst()
    } catch (error) {
      this.desk.complain(error)
    }
  }

  async openPicture(url: string, place: Place | null): Promise<void> {
    this.desk.show('pictures')
    try {
      const { view } = await this.#openPicturesOnce()
      await view.openUrl(url, place && { ...place, height_m: await this.#heightOf(place) })
    } catch (error) {
      this.desk.complain(error)
    }
  }

  /** The height of a place: its own, that of the map's raster, or that of the points that are loaded. */
  async #heightOf(place: Place): Promise<number | null> {
    return place.height_m ?? (await this.map.heightAt(place.easting_m, place.northing_m)) ?? this.#view?.groundAt(place.easting_m, place.northing_m) ?? null
  }

  async picturesOf(place: Place): Promise<void> {
    this.desk.show('pictures')
    try {
      const { view } = await this.#openPicturesOnce()
      await view.showPlace({ ...place, height_m: await this.#heightOf(place) })
    } catch (error) {
      this.desk.complain(error)
    }
  }
}

function ringLength(points: readonly (readonly [number, number])[]): number {
  let sum = 0
  for (let index = 0; index < points.length; index++) {
    const [a, b] = [points[index]!, points[(index + 1) % points.length]!]
    if (points.length === 2 && index === 1) break
    sum += Math.hypot(b[0] - a[0], b[1] - a[1])
  }
  return sum
}
