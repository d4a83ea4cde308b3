/** Layers of features: parts are loaded where the map looks; from far away, where too many would come, only their outlines. */

import Feature from 'ol/Feature'
import type { Extent } from 'ol/extent'
import LineString from 'ol/geom/LineString'
import MultiLineString from 'ol/geom/MultiLineString'
import MultiPoint from 'ol/geom/MultiPoint'
import MultiPolygon from 'ol/geom/MultiPolygon'
import Point from 'ol/geom/Point'
import Polygon, { fromExtent } from 'ol/geom/Polygon'
import VectorLayer from 'ol/layer/Vector'
import VectorSource from 'ol/source/Vector'
import OlFill from 'ol/style/Fill'
import OlStroke from 'ol/style/Stroke'
import OlStyle from 'ol/style/Style'
import { Signal } from '../core/signal'
import { type Bounds, type FeatureCollection, type FeatureDocument, type Layer, meets, type Part, type Style } from '../core/site'
import type { Source } from '../core/source'
import { coarseStyleOf, colourOf, styleOf } from './styles'

const MOST_FEATURES = 30_000
/** Each part is a request: from far away, fewer are asked for. */
const MOST_PARTS = 48
/** Outlines of smaller parts would hide the map. */
const LEAST_OUTLINE_PX = 60

/** The geometry of a document; null where there is none or its kind is unknown. */
export function geometryOf(document: FeatureDocument['geometry']) {
  if (!document) return null
  const { type, coordinates } = document
  switch (type) {
    case 'Point':
      return new Point(coordinates)
    case 'MultiPoint':
      return new MultiPoint(coordinates)
    case 'LineString':
      return new LineString(coordinates)
    case 'MultiLineString':
      return new MultiLineString(coordinates)
    case 'Polygon':
      return new Polygon(coordinates)
    case 'MultiPolygon':
      return new MultiPolygon(coordinates)
    default:
      return null
  }
}

export class FeatureLayer {
  readonly source = new VectorSource()
  readonly layer: VectorLayer<VectorSource>
  readonly style: Signal<Style>
  /** Entries of the legend that are switched off. */
  readonly hidden = new Signal<ReadonlySet<number>>(new Set())
  /** Features that are loaded, and whether that is all that the map shows of the layer. */
  readonly loaded = new Signal<{ count: number; whole: boolean }>({ count: 0, whole: false })
  readonly #parts = new Map<Part, Promise<void>>()
  readonly #outlines = new Map<Part, Feature>()
  /** What is shown from far away; null until it is first wanted. */
  #overview: Promise<Feature[]> | null = null
  #far = false
  /** Files that are on their way. */
  #waiting = 0

  constructor(
    public document: Layer,
    private readonly files: Source,
    private readonly dark: Signal<boolean>,
    private readonly complain: (error: unknown) => void,
  ) {
    this.style = new Signal(document.style)
    this.layer = new VectorLayer({
      source: this.source,
      visible: document.visible,
      zIndex: 1000 + document.order,
      declutter: Boolean(document.label),
      updateWhileInteracting: document.features < 2000,
    })
    for (const signal of [this.style, this.hidden, this.dark]) (signal as Signal<unknown>).on(() => this.#restyle())
    this.#restyle()
  }

  #restyle(): void {
    const features = styleOf(this.document, this.style.value, this.hidden.value, this.dark.value)
    const coarse = coarseStyleOf(this.style.value, this.hidden.value)
    const colour = colourOf(this.style.value, {})
    const outline = new OlStyle({
      stroke: new OlStroke({ color: colour, width: 1, lineDash: [4, 3] }),
      fill: new OlFill({ color: 'rgba(128, 128, 128, 0.08)' }),
    })
    this.layer.setStyle((feature, resolution) => {
      if (feature.get('coarse')) return coarse(feature)
      if (!feature.get('part')) return features(feature, resolution)
      const [west, , east] = feature.getGeometry()!.getExtent() as [number, number, number, number]
      return east - west > LEAST_OUTLINE_PX * resolution ? outline : []
    })
  }

  /** Load what the map shows; called after each move. */
  look(extent: Extent): void {
    if (!this.layer.getVisible()) return
    const wanted = this.document.parts.filter((part) => meets(part.bounds_m, extent as Bounds))
    const features = wanted.reduce((sum, part) => sum + part.features, 0)
    const far = features > MOST_FEATURES || wanted.length > MOST_PARTS
    if (this.document.overview) this.#lookFromFar(far)
    else if (far) for (const part of wanted) if (!this.#parts.has(part)) this.#outline(part)
    if (!far) for (const part of wanted) void this.load(part)
    this.loaded.value = { count: this.source.getFeatures().length - this.#outlines.size, whole: !far }
  }

  /** Show the coarse features, or none of them. */
  #lookFromFar(far: boolean): void {
    if (far === this.#far) return
    this.#far = far
    this.#overview ??= this.#fetched(this.document.overview!).then(
      ({ features }) => features.flatMap((one) => {
        const geometry = geometryOf(one.geometry)
        return geometry ? new Feature({ geometry, row: one.properties, coarse: true }) : []
      }),
    )
    this.#overview.then(
      (features) => {
        const shown = features.length > 0 && this.source.hasFeature(features[0]!)
        if (this.#far && !shown) this.source.addFeatures(features)
        if (!this.#far && shown) this.source.removeFeatures(features)
      },
      (error) => this.complain(error),
    )
  }

  /** True while files are on their way. */
  get isLoading(): boolean {
    return this.#waiting > 0
  }

  /** A file of features; the map draws once more when it is there, whatever it holds. */
  async #fetched(url: string): Promise<FeatureCollection> {
    this.#waiting++
    try {
      return await this.files.json<FeatureCollection>(url)
    } finally {
      this.#waiting--
      this.layer.changed()
    }
  }

  #outline(part: Part): void {
    if (this.#outlines.has(part)) return
    const feature = new Feature({ geometry: fromExtent(part.bounds_m), part: true })
    this.#outlines.set(part, feature)
    this.source.addFeature(feature)
  }

  /** Load a part, once. */
  load(part: Part): Promise<void> {
    let loading = this.#parts.get(part)
    if (!loading) {
      loading = this.#load(part).catch((error) => {
        this.#parts.delete(part)
        this.complain(error)
      })
      this.#parts.set(part, loading)
    }
    return loading
  }

  async #load(part: Part): Promise<void> {
    const { features } = await this.#fetched(part.url)
    if (!this.document.parts.includes(part)) return // the layer was replaced meanwhile
    const outline = this.#outlines.get(part)
    if (outline) {
      this.source.removeFeature(outline)
      this.#outlines.delete(part)
    }
    this.source.addFeatures(features.map((one) => this.#feature(one)).filter((one) => one !== null))
    this.loaded.value = { count: this.source.getFeatures().length - this.#outlines.size, whole: this.loaded.value.whole }
  }

  #feature(document: FeatureDocument): Feature | null {
    const geometry = geometryOf(document.geometry)
    if (!geometry) return null
    const feature = new Feature({ geometry, row: document.properties, document, layer: this.document })
    feature.setId(document.id)
    return feature
  }

  /** Show another state of the layer. */
  replace(document: Layer, extent: Extent): void {
    this.document = document
    this.#parts.clear()
    this.#outlines.clear()
    this.#overview = null
    this.#far = false
    this.source.clear(true)
    this.look(extent)
  }

  /** Load all parts: for the table of rows, and to find a row by its id. */
  async loadAll(): Promise<FeatureDocument[]> {
    await Promise.all(this.document.parts.map((part) => this.load(part)))
    const found = this.source.getFeatures().map((feature) => feature.get('document') as FeatureDocument | undefined)
    return found.filter((one) => one !== undefined).sort((a, b) => a.id - b.id)
  }

  setVisible(visible: boolean): void {
    this.layer.setVisible(visible)
  }
}
