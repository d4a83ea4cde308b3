/** Styles of layers: what a document says of colours and classes becomes styles of OpenLayers. */

import type { FeatureLike } from 'ol/Feature'
import LineString from 'ol/geom/LineString'
import Point from 'ol/geom/Point'
import CircleStyle from 'ol/style/Circle'
import Fill from 'ol/style/Fill'
import Icon from 'ol/style/Icon'
import RegularShape from 'ol/style/RegularShape'
import Stroke from 'ol/style/Stroke'
import OlStyle from 'ol/style/Style'
import Text from 'ol/style/Text'
import { css } from '../core/scales'
import type { Layer, Style } from '../core/site'

export type Row = Record<string, unknown>

/** The entries of a style's legend, and which one a row belongs to (-1: the one for what is not known). */
export function entries(style: Style): { colour: string; label: string }[] {
  return (style.classes ?? style.values ?? []).map(({ colour, label }) => ({ colour, label }))
}

export function entryOf(style: Style, row: Row): number {
  if (!style.by) return -1
  const value = row[style.by]
  if (style.classes && typeof value === 'number') {
    return style.classes.findIndex(({ from, to }) => (from === null || from <= value) && (to === null || value < to))
  }
  return style.values?.findIndex((entry) => entry.value === value) ?? -1
}

export function colourOf(style: Style, row: Row): string {
  if (!style.by) return style.colour ?? '#0072b2'
  const entry = entryOf(style, row)
  return entry < 0 ? (style.none?.colour ?? '#9e9e9e') : entries(style)[entry]!.colour
}

/** A style function of a layer; equal colours share one style. */
export function styleOf(layer: Layer, style: Style, hidden: ReadonlySet<number>, dark: boolean) {
  const made = new Map<string, OlStyle[]>()
  return (feature: FeatureLike, resolution: number): OlStyle[] => {
    const row = feature.get('row') as Row
    if (hidden.size && hidden.has(entryOf(style, row))) return []
    const colour = colourOf(style, row)
    let styles = made.get(colour)
    if (!styles) made.set(colour, (styles = drawn(layer, colour, style.width_px ?? 2, dark)))
    const more = layer.arrows ? arrows(feature, row, layer.arrows, resolution) : []
    const label = layer.label && resolution < 0.5 ? lettering(row[layer.label], dark) : []
    return more.length || label.length ? [...styles, ...more, ...label] : styles
  }
}

/** The same from far away, where there are many features: a thin line of one colour. */
export function coarseStyleOf(style: Style, hidden: ReadonlySet<number>) {
  const made = new Map<string, OlStyle>()
  return (feature: FeatureLike): OlStyle[] => {
    const row = feature.get('row') as Row
    if (hidden.size && hidden.has(entryOf(style, row))) return []
    const colour = colourOf(style, row)
    let drawn = made.get(colour)
    if (!drawn) made.set(colour, (drawn = new OlStyle({ stroke: new Stroke({ color: css(colour), width: Math.min(3, style.width_px ?? 2), lineCap: 'butt' }) })))
    return [drawn]
  }
}

function drawn(layer: Layer, colour: string, width_px: number, dark: boolean): OlStyle[] {
  const edge = dark ? 'rgba(16, 18, 22, 0.9)' : 'rgba(255, 255, 255, 0.9)'
  if (layer.geometry === 'point') {
    const radius = Math.max(3.5, width_px / 2)
    // Lettering gives way to lettering; a point is always drawn.
    return [new OlStyle({ image: new CircleStyle({ radius, fill: new Fill({ color: css(colour) }), stroke: new Stroke({ color: edge, width: 1.5 }), declutterMode: 'none' }) })]
  }
  const stroke = new Stroke({ color: css(colour), width: width_px, lineCap: 'butt' })
  if (layer.geometry === 'polygon') return [new OlStyle({ stroke, fill: new Fill({ color: css(colour, 0.25) }) })]
  if (width_px < 3) return [new OlStyle({ stroke })]
  return [new OlStyle({ stroke: new Stroke({ color: edge, width: width_px + 2, lineCap: 'butt' }) }), new OlStyle({ stroke })]
}

function lettering(text: unknown, dark: boolean): OlStyle[] {
  if (text === null || text === undefined || text === '') return []
  return [
    new OlStyle({
      text: new Text({
        text: String(text).slice(0, 60),
        font: '500 12px system-ui, sans-serif',
        offsetY: -13,
        overflow: true,
        fill: new Fill({ color: dark ? '#e8eaed' : '#1b1f24' }),
        stroke: new Stroke({ color: dark ? 'rgba(16,18,22,.85)' : 'rgba(255,255,255,.9)', width: 3 }),
      }),
    }),
  ]
}

const HORIZONTAL = '#d55e00'
const VERTICAL = '#0072b2'

/** The residual of a point: an arrow in the plane, and a bar to the north (up) or south (down) for the height. */
function arrows(feature: FeatureLike, row: Row, columns: NonNullable<Layer['arrows']>, resolution: number): OlStyle[] {
  const foot = (feature.getGeometry() as Point).getCoordinates()
  const [east, north, up] = [row[columns.east], row[columns.north], row[columns.up]].map((one) => (typeof one === 'number' ? one : 0))
  const styles: OlStyle[] = []
  const add = (end: number[], colour: string, headed: boolean): void => {
    const [dx, dy] = [end[0]! - foot[0]!, end[1]! - foot[1]!]
    if (Math.hypot(dx, dy) < 2 * resolution) return
    styles.push(new OlStyle({ geometry: new LineString([foot, end]), stroke: new Stroke({ color: css(colour), width: headed ? 2 : 4, lineCap: 'butt' }) }))
    if (!headed) return
    const head = new RegularShape({ points: 3, radius: 6, fill: new Fill({ color: css(colour) }), rotation: Math.atan2(dx, dy), rotateWithView: true, declutterMode: 'none' })
    styles.push(new OlStyle({ geometry: new Point(end), image: head }))
  }
  const factor = columns.exaggeration
  add([foot[0]!, foot[1]! + up! * factor], VERTICAL, false)
  add([foot[0]! + east! * factor, foot[1]! + north! * factor], HORIZONTAL, true)
  return styles
}

export const ARROW_COLOURS = { horizontal: HORIZONTAL, vertical: VERTICAL }

/** How the selected feature is drawn, over all others. */
export function highlight(dark: boolean): OlStyle[] {
  const [halo, colour] = dark ? ['rgba(0,0,0,.75)', '#ffd43b'] : ['rgba(255,255,255,.95)', '#c2255c']
  return [
    new OlStyle({
      stroke: new Stroke({ color: halo, width: 8 }),
      image: new CircleStyle({ radius: 11, stroke: new Stroke({ color: halo, width: 6 }) }),
    }),
    new OlStyle({
      stroke: new Stroke({ color: colour, width: 3 }),
      fill: new Fill({ color: css(colour, 0.15) }),
      image: new CircleStyle({ radius: 11, stroke: new Stroke({ color: colour, width: 2.5 }) }),
    }),
  ]
}

const CROSS = (colour: string, halo: string): string =>
  'data:image/svg+xml;charset=utf-8,' +
  encodeURIComponent(
    `<svg xmlns="http://www.w3.org/2000/svg" width="33" height="33" viewBox="0 0 33 33" fill="none">` +
      `<path d="M16.5 1v11M16.5 21v11M1 16.5h11M21 16.5h11" stroke="${halo}" stroke-width="4"/>` +
      `<path d="M16.5 1v11M16.5 21v11M1 16.5h11M21 16.5h11" stroke="${colour}" stroke-width="1.6"/>` +
      `<circle cx="16.5" cy="16.5" r="1.4" fill="${colour}"/></svg>`,
  )

/** The cross at the picked place. */
export function crosshair(dark: boolean): OlStyle {
  return new OlStyle({ image: new Icon({ src: dark ? CROSS('#ffd43b', '#000') : CROSS('#c2255c', '#fff') }) })
}

/** The place of the strips' cursor: a ring. */
export function ring(dark: boolean): OlStyle {
  return new OlStyle({
    image: new CircleStyle({
      radius: 7,
      fill: new Fill({ color: dark ? '#101216' : '#fff' }),
      stroke: new Stroke({ color: dark ? '#ffd43b' : '#c2255c', width: 3 }),
    }),
  })
}

/** Lines that are being measured. */
export function measuring(dark: boolean): OlStyle[] {
  const colour = dark ? '#ffd43b' : '#c2255c'
  return [
    new OlStyle({ stroke: new Stroke({ color: dark ? '#000' : '#fff', width: 5 }) }),
    new OlStyle({
      stroke: new Stroke({ color: colour, width: 2 }),
      fill: new Fill({ color: css(colour, 0.12) }),
      image: new CircleStyle({ radius: 4, fill: new Fill({ color: colour }), stroke: new Stroke({ color: dark ? '#000' : '#fff', width: 1.5 }) }),
    }),
  ]
}
