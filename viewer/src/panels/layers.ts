/** The list of layers: what is shown, in which colours, and the legend. */

import { fill, h, iconButton, s } from '../core/dom'
import * as format from '../core/format'
import { css, ramp, SCALE_NAMES } from '../core/scales'
import type { Style } from '../core/site'
import type { MapView } from '../map/map'
import type { RasterLayer } from '../map/rasters'
import { ARROW_COLOURS, entries } from '../map/styles'
import type { FeatureLayer } from '../map/vectors'

const GROUPS: Record<string, string> = { survey: 'Survey', control: 'Control', condition: 'Condition', distress: 'Distress', assets: 'Assets' }

export function layersPanel(map: MapView, openTable: (layer: FeatureLayer) => void): HTMLElement {
  const names = [...Object.keys(GROUPS), ...map.layers.map((one) => one.document.group)]
  const groups = [...new Set(names)].map((name) => [name, map.layers.filter((one) => one.document.group === name)] as const)
  return h(
    'div',
    { class: 'layers' },
    ...groups.filter(([, layers]) => layers.length).map(([name, layers]) => group(GROUPS[name] ?? name, layers.map((one) => featureRow(map, one, openTable)))),
    map.rasters.length > 0 && group('Ground', map.rasters.map(rasterRow)),
  )
}

function group(title: string, rows: HTMLElement[]): HTMLElement {
  return h('section', { class: 'layer-group' }, h('h3', {}, title), ...rows)
}

function featureRow(map: MapView, layer: FeatureLayer, openTable: (layer: FeatureLayer) => void): HTMLElement {
  const { document } = layer
  const legend = h('div', { class: 'legend' })
  const count = h('span', { class: 'count' })
  const box = h('input', {
    type: 'checkbox',
    checked: layer.layer.getVisible(),
    onchange: () => {
      layer.setVisible(box.checked)
      map.look()
      draw()
    },
  })
  const draw = (): void => {
    legend.hidden = !box.checked
    if (box.checked) fill(legend, chooser(layer), legendOf(layer))
  }
  layer.style.on(draw)
  layer.hidden.on(draw)
  count.textContent = format.fixed(document.features, 0)
  draw()
  return h(
    'div',
    { class: 'layer' },
    h(
      'div',
      { class: 'layer-head' },
      h('label', { class: 'check' }, box, h('span', {}, document.title)),
      count,
      iconButton('table', `Rows of ${document.title}`, () => openTable(layer), { class: 'icon-button small' }),
    ),
    legend,
  )
}

function chooser(layer: FeatureLayer): HTMLElement | null {
  const choices = layer.document.choices.length ? layer.document.choices : [layer.document.style]
  if (choices.length < 2) return layer.style.value.by ? h('p', { class: 'legend-title' }, layer.style.value.title) : null
  const chosen = Math.max(0, choices.findIndex((one) => one.title === layer.style.value.title))
  const select = h(
    'select',
    {
      'aria-label': `Colours of ${layer.document.title}`,
      onchange: () => {
        layer.hidden.value = new Set()
        layer.style.value = choices[Number(select.value)]!
      },
    },
    ...choices.map((one, index) => h('option', { value: index, selected: index === chosen }, one.title)),
  )
  return select
}

/** A swatch as the layer draws: a line, a dot or an area. */
function swatch(layer: FeatureLayer, style: Style, colour: string): SVGElement {
  const mark =
    layer.document.geometry === 'point'
      ? s('circle', { cx: 8, cy: 7, r: 4.5, fill: css(colour) })
      : layer.document.geometry === 'line'
        ? s('path', { d: 'M1 7h14', stroke: css(colour), 'stroke-width': Math.min(6, style.width_px ?? 2) })
        : s('rect', { x: 1.5, y: 2, width: 13, height: 10, fill: css(colour, 0.25), stroke: css(colour), 'stroke-width': 1.5 })
  return s('svg', { viewBox: '0 0 16 14', class: 'key', 'aria-hidden': 'true' }, mark)
}

function legendOf(layer: FeatureLayer): HTMLElement {
  const style = layer.style.value
  const list = entries(style)
  const rows = list.map((entry, index) => legendEntry(layer, style, index, entry))
  if (style.by && style.none) rows.push(legendEntry(layer, style, -1, style.none))
  if (!style.by && layer.document.arrows === null) return h('div', { class: 'single' }, swatch(layer, style, style.colour ?? '#0072b2'))
  return h('ul', { class: 'entries' }, ...rows, ...arrowRows(layer))
}

function legendEntry(layer: FeatureLayer, style: Style, index: number, entry: { colour: string; label: string }): HTMLElement {
  const shown = !layer.hidden.value.has(index)
  return h(
    'li',
    {},
    h(
      'button',
      {
        type: 'button',
        class: 'entry',
        'aria-pressed': String(shown),
        title: shown ? `Hide: ${entry.label}` : `Show: ${entry.label}`,
        onclick: () => {
          const hidden = new Set(layer.hidden.value)
          if (!hidden.delete(index)) hidden.add(index)
          layer.hidden.value = hidden
        },
      },
      swatch(layer, style, entry.colour),
      h('span', {}, entry.label),
    ),
  )
}

function arrowRows(layer: FeatureLayer): HTMLElement[] {
  const { arrows } = layer.document
  if (!arrows) return []
  const row = (d: string, colour: string, width: number, text: string): HTMLElement =>
    h('li', { class: 'entry' }, s('svg', { viewBox: '0 0 16 14', class: 'key', 'aria-hidden': 'true' }, s('path', { d, stroke: css(colour), 'stroke-width': width, fill: 'none' })), h('span', {}, text))
  const factor = format.fixed(arrows.exaggeration, 0)
  return [
    row('M1 7h12M9 3l5 4-5 4', ARROW_COLOURS.horizontal, 1.8, `horizontal residual, × ${factor}`),
    row('M8 13V1', ARROW_COLOURS.vertical, 4, `height residual, × ${factor}, north is up`),
  ]
}

function rasterRow(one: RasterLayer): HTMLElement {
  const { raster, layer } = one
  const legend = h('div', { class: 'legend' })
  const box = h('input', {
    type: 'checkbox',
    checked: layer.getVisible(),
    onchange: () => {
      layer.setVisible(box.checked)
      draw()
    },
  })
  const draw = (): void => {
    legend.hidden = !box.checked
    if (box.checked) fill(legend, rasterLegend(one, draw))
  }
  draw()
  return h('div', { class: 'layer' }, h('div', { class: 'layer-head' }, h('label', { class: 'check' }, box, h('span', {}, raster.title))), legend)
}

function rasterLegend(one: RasterLayer, redraw: () => void): HTMLElement {
  const { raster, layer } = one
  const opacity = h('input', {
    type: 'range',
    min: 0,
    max: 1,
    step: 0.05,
    value: layer.getOpacity(),
    'aria-label': `Opacity of ${raster.title}`,
    oninput: () => layer.setOpacity(Number(opacity.value)),
  })
  const limit = (name: 'from' | 'to'): HTMLInputElement => {
    const input = h('input', {
      type: 'number',
      step: 'any',
      value: Number(one[name].toPrecision(6)),
      'aria-label': `${name === 'from' ? 'Lower' : 'Upper'} end of the scale of ${raster.title}${raster.unit ? ` (${raster.unit})` : ''}`,
      onchange: () => {
        const value = Number(input.value)
        if (!Number.isFinite(value)) return
        one.restyle(name === 'from' ? value : one.from, name === 'to' ? value : one.to, one.colours)
      },
    })
    return input
  }
  const select = h(
    'select',
    {
      'aria-label': `Colour scale of ${raster.title}`,
      onchange: () => {
        one.restyle(one.from, one.to, select.value)
        redraw()
      },
    },
    ...SCALE_NAMES.map((name) => h('option', { value: name, selected: name === one.colours }, name)),
  )
  return h(
    'div',
    { class: 'ramp' },
    ramp(one.colours, 200, 8),
    h('div', { class: 'ramp-ends' }, limit('from'), raster.unit ? h('span', {}, raster.unit) : null, limit('to')),
    h('div', { class: 'row' }, select, h('label', { class: 'slider', title: 'Opacity' }, opacity)),
  )
}
