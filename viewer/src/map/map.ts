/** The map in the survey's own plane: no other projection, so what is read back is the survey's. */

import Feature from 'ol/Feature'
import OlMap from 'ol/Map'
import View from 'ol/View'
import { defaults as defaultControls } from 'ol/control/defaults'
import type { Extent } from 'ol/extent'
import { boundingExtent, buffer, getCenter, getHeight, getWidth } from 'ol/extent'
import Point from 'ol/geom/Point'
import { defaults as defaultInteractions } from 'ol/interaction/defaults'
import VectorLayer from 'ol/layer/Vector'
import Projection from 'ol/proj/Projection'
import VectorSource from 'ol/source/Vector'
import type { Desk, Place } from '../core/desk'
import { h, iconButton } from '../core/dom'
import * as format from '../core/format'
import { Signal } from '../core/signal'
import type { FeatureDocument, Layer } from '../core/site'
import { Measuring, type MapTool, type Measured } from './measure'
import { Pyramid, RasterLayer } from './rasters'
import { crosshair, highlight, ring } from './styles'
import { FeatureLayer, geometryOf } from './vectors'

const TOUCH_PX = 7
/** OpenLayers waits so long for a second click, and a little is added. */
const SINGLE_CLICK_MS = 350

export interface Hit {
  layer: Layer
  feature: FeatureDocument
}

export class MapView {
  readonly element: HTMLElement
  readonly map: OlMap
  readonly layers: FeatureLayer[]
  readonly rasters: RasterLayer[]
  readonly tool = new Signal<MapTool>('select')
  readonly measured = new Signal<{ measured: Measured; remove: () => void } | null>(null)
  readonly measuring: Measuring
  /** Called with what lies below a click, nearest first; another part may take the click for itself. */
  clicked: (place: Place, hits: Hit[]) => void = () => {}
  /** Called when layers were replaced. */
  replaced: () => void = () => {}
  readonly #marks = new VectorSource()
  readonly #cross = new Feature()
  readonly #ring = new Feature()
  readonly #selection = new VectorSource()
  readonly #tip = h('div', { class: 'map-tip', hidden: true })
  #drawing = false
  #drawn = 0
  /** Where the way that the map goes by itself ends. */
  #goal: { center: number[]; resolution: number } | null = null
  readonly #bar = h('div', { class: 'scale-bar', 'aria-hidden': 'true' })

  constructor(readonly desk: Desk) {
    const { survey } = desk
    const extent = buffer(survey.extent_m as Extent, 0.5 * Math.max(getWidth(survey.extent_m), getHeight(survey.extent_m), 100))
    const projection = new Projection({ code: 'survey', units: 'm', extent, global: false })
    this.rasters = this.#makeRasters(projection)
    this.layers = [...survey.layers].sort((a, b) => a.order - b.order).map((layer) => this.#layerOf(layer))
    const target = h('div', {
      class: 'map-target',
      tabindex: 0,
      role: 'application',
      'aria-label': 'Map. Arrow keys move it, plus and minus zoom, Enter selects what lies under the cross in the middle.',
    })
    this.map = new OlMap({
      target,
      controls: defaultControls({ attribution: false, zoom: false, rotate: false }),
      interactions: defaultInteractions({ altShiftDragRotate: false, pinchRotate: false, doubleClickZoom: true }),
      layers: [...this.rasters.map((one) => one.layer), ...this.layers.map((one) => one.layer)],
      view: new View({ projection, center: getCenter(survey.extent_m), resolution: 1, minResolution: 0.0005, maxResolution: 5000, smoothResolutionConstraint: false, showFullExtent: true }),
      moveTolerance: 4,
    })
    const selected = new VectorLayer({ source: this.#selection, zIndex: 6000 })
    const marks = new VectorLayer({ source: this.#marks, zIndex: 7000 })
    this.map.addLayer(selected)
    this.map.addLayer(marks)
    desk.dark.on((dark) => {
      selected.setStyle(highlight(dark))
      this.#cross.setStyle(crosshair(dark))
      this.#ring.setStyle(ring(dark))
    }, true)
    this.measuring = new Measuring(this.map, desk.dark, (measured, feature) => {
      this.measured.value = { measured, remove: () => this.measuring.remove(feature) }
    }, (measured) => this.#showTip(measured))
    this.map.addLayer(this.measuring.layer)
    this.element = h('div', { class: 'map-view' }, target, h('div', { class: 'map-centre', 'aria-hidden': 'true' }), this.#tip, this.#buttons(), this.#bar)
    this.#listen(target)
  }

  #makeRasters(projection: Projection): RasterLayer[] {
    const { survey, source } = this.desk
    if (!survey.raster_grid) return []
    const pyramid = new Pyramid(survey.raster_grid, source)
    return survey.rasters.map((raster) => new RasterLayer(raster, pyramid, projection, (error) => this.desk.complain(error)))
  }

  #buttons(): HTMLElement {
    return h(
      'div',
      { class: 'view-buttons' },
      iconButton('plus', 'Zoom in (+)', () => this.#zoom(0.5)),
      iconButton('minus', 'Zoom out (-)', () => this.#zoom(2)),
      iconButton('fit', 'Show the whole survey (0)', () => this.fit()),
    )
  }

  /** Zoom by a factor; a press while the map is under way counts from where that ends. */
  #zoom(factor: number): void {
    const view = this.map.getView()
    const under = view.getAnimating() ? this.#goal : null
    const wanted = (under?.resolution ?? view.getResolution()!) * factor
    this.#setOut(under?.center ?? view.getCenter()!, view.getConstrainedResolution(wanted) ?? wanted, 150)
  }

  #setOut(center: number[], resolution: number, duration: number): void {
    const view = this.map.getView()
    this.#goal = { center, resolution }
    view.cancelAnimations()
    view.animate({ center, resolution, duration })
  }

  /** Whether the map stands still, with all that it has to show: a picture from before it set out tells nothing. */
  #tellDrawn(): void {
    const drawn = !this.map.getView().getAnimating() && this.layers.every((one) => !one.isLoading)
    this.element.dataset['drawn'] = String(drawn)
  }

  #listen(target: HTMLElement): void {
    const { desk, map } = this
    const still = (drawn: boolean): void => void (this.element.dataset['drawn'] = String(drawn))
    map.on('moveend', () => this.look())
    map.on('precompose', () => still(false))
    map.getView().on('change', () => still(false))
    map.on('rendercomplete', () => this.#tellDrawn())
    map.getView().on('change:resolution', () => this.#drawBar())
    map.on('singleclick', (event) => {
      if (!this.measuring.busy && !this.#drawing) void this.#click(event.pixel, event.coordinate)
    })
    map.on('pointermove', (event) => {
      if (event.dragging) return
      const [easting_m, northing_m] = event.coordinate as [number, number]
      desk.pointer.value = { easting_m, northing_m, height_m: null, from: 'map' }
      const over = !this.measuring.busy && map.hasFeatureAtPixel(event.pixel, { hitTolerance: 3, layerFilter: (layer) => this.layers.some((one) => one.layer === layer) })
      target.style.cursor = this.measuring.busy ? 'crosshair' : over ? 'pointer' : ''
    })
    // A press means what is seen now, though the map may not have been told yet that it has other room.
    target.addEventListener('pointerdown', () => {
      const [width, height] = map.getSize() ?? [0, 0]
      if (width === target.clientWidth && height === target.clientHeight) return
      map.updateSize()
      map.renderSync()
    }, { capture: true })
    target.addEventListener('pointerleave', () => (desk.pointer.value = null))
    target.addEventListener('keydown', (event) => {
      if (event.key === 'Enter') {
        const centre = map.getView().getCenter()!
        if (this.measuring.busy) this.measuring.corner(centre)
        else void this.#click(map.getPixelFromCoordinate(centre), centre)
      } else if (event.key === '0') this.fit()
      else return
      event.preventDefault()
    })
    desk.selected.on((selected) => {
      this.#selection.clear()
      const geometry = selected && geometryOf(selected.feature.geometry)
      if (geometry) this.#selection.addFeature(new Feature(geometry))
    })
    desk.place.on((place) => this.#mark(this.#cross, place ? [place.easting_m, place.northing_m] : null))
    desk.target.on((goal) => {
      if (!goal) return
      still(false)
      const size = map.getSize() ?? [400, 400]
      const resolution = goal.across_m ? goal.across_m / Math.max(100, Math.min(size[0]!, size[1]!)) : map.getView().getResolution()!
      this.#setOut([goal.easting_m, goal.northing_m], resolution, 350)
    })
    this.tool.on((tool) => this.measuring.use(tool))
    new ResizeObserver(() => {
      map.updateSize()
      this.#drawBar()
    }).observe(target)
  }

  /** While something is drawn, clicks select nothing; the last one comes as a single click only after a while. */
  set drawing(drawing: boolean) {
    window.clearTimeout(this.#drawn)
    if (drawing) this.#drawing = true
    else this.#drawn = window.setTimeout(() => (this.#drawing = false), SINGLE_CLICK_MS)
  }

  /** Load the features that the map shows now. */
  look(): void {
    const extent = this.map.getView().calculateExtent(this.map.getSize())
    for (const layer of this.layers) layer.look(extent)
    this.#drawBar()
  }

  fit(extent: Extent = this.desk.survey.extent_m, duration = 200): void {
    const size = this.map.getSize()
    if (!size || !size[0] || !size[1]) return
    const least = boundingExtent([[extent[0]!, extent[1]!], [extent[2]!, extent[3]!]])
    this.map.getView().fit(buffer(least, 1), { size, padding: [24, 24, 24, 24], duration })
  }

  async #click(pixel: number[], [easting_m, northing_m]: number[]): Promise<void> {
    const hits: Hit[] = []
    this.map.forEachFeatureAtPixel(
      pixel,
      (feature) => {
        const document = feature.get('document') as FeatureDocument | undefined
        const layer = feature.get('layer') as Layer | undefined
        if (document && layer && !hits.some((hit) => hit.feature === document)) hits.push({ layer, feature: document })
      },
      { hitTolerance: TOUCH_PX },
    )
    const rank = { point: 0, line: 1, polygon: 2 }
    hits.sort((a, b) => rank[a.layer.geometry] - rank[b.layer.geometry] || b.layer.order - a.layer.order)
    const notes = await this.valuesAt(easting_m!, northing_m!)
    const height = notes.find(([name]) => name === 'height')
    this.clicked(
      {
        easting_m: easting_m!,
        northing_m: northing_m!,
        height_m: height ? height[2] : null,
        from: 'map',
        notes: notes.filter(([name]) => name !== 'height').map(([, title, , text]) => [title, text]),
      },
      hits,
    )
  }

  /** Show another state of some layers, and layers that were not there before. */
  replace(layers: readonly Layer[]): void {
    const extent = this.map.getView().calculateExtent(this.map.getSize())
    for (const document of layers) {
      const held = this.layers.find((one) => one.document.name === document.name)
      if (held) held.replace(document, extent)
      else {
        const layer = this.#layerOf(document)
        this.layers.push(layer)
        this.map.addLayer(layer.layer)
        layer.look(extent)
      }
    }
    this.layers.sort((a, b) => a.document.order - b.document.order)
    this.replaced()
  }

  #layerOf(document: Layer): FeatureLayer {
    const { source, dark } = this.desk
    return new FeatureLayer(document, source, dark, (error) => this.desk.complain(error))
  }

  /** Height of the surface at a place (m); null where no raster knows it. */
  async heightAt(easting_m: number, northing_m: number): Promise<number | null> {
    return (await this.valuesAt(easting_m, northing_m)).find(([name]) => name === 'height')?.[2] ?? null
  }

  /** Values of all rasters at a place: name, title, value, its text. */
  async valuesAt(easting_m: number, northing_m: number): Promise<[string, string, number, string][]> {
    const found = await Promise.all(
      this.rasters.map(async (one) => {
        const { raster } = one
        const read = await one.read(easting_m, northing_m, 0)
        if (!read) return null
        const text = `${format.number(read.value)}${raster.unit ? `\u202f${raster.unit}` : ''}`
        return [raster.name, raster.title, read.value, text] as [string, string, number, string]
      }),
    )
    return found.filter((one) => one !== null)
  }

  /** The middle of the map and the metres that are seen of its shorter side. */
  get seen(): { centre: [number, number]; across_m: number } {
    const view = this.map.getView()
    const size = this.map.getSize() ?? [400, 400]
    return { centre: view.getCenter() as [number, number], across_m: view.getResolution()! * Math.min(size[0]!, size[1]!) }
  }

  markStation(place: [number, number] | null): void {
    this.#mark(this.#ring, place)
  }

  #mark(feature: Feature, place: [number, number] | null): void {
    feature.setGeometry(place ? new Point(place) : undefined)
    const there = this.#marks.hasFeature(feature)
    if (place && !there) this.#marks.addFeature(feature)
    if (!place && there) this.#marks.removeFeature(feature)
  }

  #showTip(measured: Measured | null): void {
    this.#tip.hidden = !measured
    if (!measured) return
    const parts = [format.length(measured.length_m)]
    if (measured.area_m2 !== null) parts.push(`${format.fixed(measured.area_m2, 3)}\u202fm²`)
    this.#tip.textContent = parts.join('  ·  ')
  }

  #drawBar(): void {
    const resolution = this.map.getView().getResolution()!
    const most = 110 * resolution
    const power = 10 ** Math.floor(Math.log10(most))
    const metres = [5, 2, 1].map((digit) => digit * power).find((one) => one <= most) ?? power
    this.#bar.style.width = `${metres / resolution}px`
    this.#bar.textContent = metres >= 1000 ? `${metres / 1000} km` : metres >= 1 ? `${metres} m` : metres >= 0.01 ? `${Math.round(metres * 100)} cm` : `${+(metres * 1000).toPrecision(1)} mm`
  }
}
