/** The documents of a published survey (layout 1). Coordinates are metres of the survey's own map. */

export type Bounds = [number, number, number, number]

/** Easting and northing are sums of c · x^i · y^j over i + j ≤ degree, with x and y the degrees scaled to −1 to 1. */
export interface Degrees {
  middle: [number, number]
  half: [number, number]
  degree: number
  easting: number[]
  northing: number[]
  error_m: number
}

export interface Unit {
  name: string
  m: number
}

export interface Survey {
  layout: number
  software: string
  id: string
  title: string | null
  crs: {
    name: string | null
    authority: string | null
    is_local: boolean
    horizontal_unit: Unit
    vertical_unit: Unit
    height: string | null
    geoid: string | null
  }
  origin_m: [number, number, number]
  /** Null where there is nothing to be shown; the page opens no such survey. */
  extent_m: Bounds
  height_extent_m: [number, number] | null
  lon_lat: [number, number] | null
  /** Polynomials from degrees (WGS 84) to the map; null or missing where there are none. */
  degrees?: Degrees | null
  tile_m: number
  cell_m: number
  sheet_m: number
  layers: Layer[]
  raster_grid: RasterGrid | null
  rasters: Raster[]
  clouds: { url: string; points: number } | null
  meshes: { url: string; meshes: number } | null
  strips: { url: string; lanes: number } | null
  pictures: { url: string; pictures: number } | null
  report: string | null
  left_out?: string[]
  cogs?: string[]
  features?: string[]
  catalog?: { collection: string; items: string; points: string | null } | null
  edits?: EditRules | null
  /** Where the server of `roadscan view` is asked about pictures; null or missing where there is none. */
  measuring?: MeasuringRules | null
}

export interface MeasuringRules {
  measure: string
  /** Null where no control point can be clicked. */
  control: string | null
}

/** Which layers are edited, where edits are sent (null: into a file), and what they are made on. */
export interface EditRules {
  layers: string[]
  /** What can be drawn, whether the survey shows any of it or not. */
  kinds: EditKind[]
  /** Where their forms lie. */
  forms: string
  post: string | null
  inventory: string
  commit: number
}

export interface EditKind {
  layer: string
  title: string
  geometry: Geometry
}

/** By layer: the columns that people fill in. */
export interface EditForms {
  columns: Record<string, Column[]>
}

export interface Column {
  name: string
  title: string
  unit: string | null
  meaning: string | null
  sigma?: string | null
  /** Where people may change it: the type of its values, and those that there are; all where none is named. */
  edited?: { type: 'bool' | 'date' | 'float64' | 'int32' | 'int64' | 'string'; values: string[] } | null
}

export interface Class {
  from: number | null
  to: number | null
  colour: string
  label: string
}

export interface Style {
  title: string
  by: string | null
  colour?: string
  width_px?: number
  none?: { colour: string; label: string }
  classes?: Class[]
  values?: { value: unknown; colour: string; label: string }[]
}

export interface Part {
  url: string
  bounds_m: Bounds
  features: number
}

export type Geometry = 'point' | 'line' | 'polygon'

export interface Layer {
  name: string
  title: string
  group: string
  geometry: Geometry
  order: number
  visible: boolean
  features: number
  parts: Part[]
  key: string | null
  label: string | null
  columns: Column[]
  style: Style
  choices: Style[]
  /** All features of a layer that lies in many parts, as they are seen from far away. */
  overview?: string | null
  arrows: { east: string; north: string; up: string; exaggeration: number } | null
}

export interface Evidence {
  title: string
  /** `picture` and `cut_out` have a `url`, `tile` a tile, `row` a layer and a row, `station` a road and a station. */
  kind: string
  tile?: string
  url?: string
  layer?: string
  row?: string
  road?: string
  lane?: string | null
  station_m?: number
}

export interface FeatureDocument {
  type: 'Feature'
  id: number
  geometry: { type: string; coordinates: any } | null
  properties: Record<string, unknown>
  evidence?: Evidence[]
}

export interface FeatureCollection {
  features: FeatureDocument[]
}

export interface RasterLevel {
  level: number
  pixel_m: number
  tile_m: number
  columns: [number, number]
  rows: [number, number]
  count: number
  tiles: string
}

export interface RasterGrid {
  tile_px: number
  levels: RasterLevel[]
}

export interface Raster {
  name: string
  title: string
  unit: string
  encoding: 'rgb24' | 'grey8'
  offset: number
  step: number
  from: number
  to: number
  colours: string
  order: number
  visible: boolean
  url: string
}

export interface CloudIndex {
  points: number
  bytes: number | null
  sheets: { name: string; url: string; bounds_m: [number, number, number, number, number, number]; points: number; bytes: number | null }[]
  colours: string[]
  has_colours: boolean | null
  intensity: [number, number] | null
  classes: { class: number; title: string; colour: string }[]
  passes: { pass: number; title: string; colour: string }[]
}

export interface MeshIndex {
  meshes: { tile: string; url: string; origin_m: [number, number, number]; bounds_m: Bounds; bytes: number }[]
}

export interface StripLane {
  lane_id: number
  survey: string
  survey_title?: string | null
  road: string
  name: string | null
  lane: string
  direction: string
  station_m: [number, number]
  /** Box of its middle. */
  bounds_m?: Bounds
  url: string
  /** Where the values of a long lane lie, whose own file has bins. */
  pieces?: StripPiece[]
  cross_sections: StripPiece[]
}

export interface StripPiece {
  from_m: number
  to_m: number
  url: string
}

export interface Quantity {
  name: string
  title: string
  unit: string
  meaning: string
}

export interface StripIndex {
  lanes: StripLane[]
  quantities: Quantity[]
  panels: { title: string; quantities: string[] }[]
}

export interface StripSeries {
  quantity: string
  extent: 'section' | 'cross_section'
  from_m: number[]
  to_m: number[]
  value: (number | null)[]
  sigma: (number | null)[]
  share: (number | null)[]
  reason: (string | null)[]
  /** Least and greatest of each bin, where the values are means of bins. */
  low?: (number | null)[]
  high?: (number | null)[]
}

export interface Strip {
  lane_id: number
  line: { station_m: number[]; easting_m: number[]; northing_m: number[] }
  series: StripSeries[]
}

export interface CrossSection {
  station_m: number
  easting_m: number
  northing_m: number
  direction_deg: number | null
  first_m: number
  step_m: number
  height_m: number
  relative_height_mm: (number | null)[]
}

export interface Camera {
  camera: number
  run: string
  title: string
  model: 'perspective' | 'equirectangular'
  width_px: number
  height_px: number
  /** Pixels a unit of the tangent; of an equirectangular picture, a radian. */
  focal_px: [number, number]
  principal_px: [number, number]
  distortion: [number, number, number, number, number] | null
}

export interface PictureIndex {
  cameras: Camera[]
  parts: { url: string; bounds_m: Bounds; pictures: number }[]
}

export interface PictureColumns {
  pictures: number
  id: number[]
  camera: number[]
  url: string[]
  epoch_gps_ns: string[]
  easting_m: number[]
  northing_m: number[]
  height_m: number[]
  camera_from_map: number[][]
  sigma_m: (number | null)[]
  name?: (string | null)[]
}

/** True where two rectangles meet. */
export function meets(a: Bounds, b: Bounds): boolean {
  return a[0] <= b[2] && b[0] <= a[2] && a[1] <= b[3] && b[1] <= a[3]
}
