/** What was measured, as a list: figures with all digits, to be copied or removed. */

import type { Desk } from '../core/desk'
import { h, iconButton } from '../core/dom'
import * as format from '../core/format'
import { copyText } from './row'

export interface Figure {
  title: string
  lines: [string, string][]
  /** Corner points, for the copy. */
  points: readonly (readonly number[])[]
  remove?: () => void
  show?: () => void
  /** Offers it as a file. */
  save?: () => void
  /** What speaks against it, or was assumed. */
  notes?: string[]
}

export class Measurements {
  readonly #list = h('div', { class: 'figures' })
  readonly element = h('section', { class: 'measurements', hidden: true, 'aria-live': 'polite' }, h('h3', {}, 'Measured'), this.#list)

  constructor(readonly desk: Desk) {}

  add(figure: Figure): void {
    const card: HTMLElement = h(
      'div',
      { class: 'figure' },
      h(
        'div',
        { class: 'figure-head' },
        h('h4', {}, figure.title),
        figure.show ? iconButton('section', 'Show the section again', figure.show, { class: 'icon-button small' }) : null,
        figure.save ? iconButton('down', 'Save it as GeoJSON', figure.save, { class: 'icon-button small' }) : null,
        iconButton('copy', 'Copy the figures', () => this.#copy(figure), { class: 'icon-button small' }),
        iconButton('close', 'Remove it', () => {
          figure.remove?.()
          card.remove()
          this.element.hidden = !this.#list.childElementCount
        }, { class: 'icon-button small' }),
      ),
      h('dl', { class: 'values' }, ...figure.lines.map(([name, text]) => h('div', {}, h('dt', {}, name), h('dd', { class: 'number' }, text)))),
      ...(figure.notes ?? []).map((note) => h('p', { class: 'hint' }, note)),
    )
    this.#list.prepend(card)
    this.element.hidden = false
  }

  #copy(figure: Figure): void {
    const lines = figure.lines.map(([name, text]) => `${name}\t${text.replace(/\u202f/g, ' ')}`)
    const corners = figure.points.map((point) => point.map((one) => one.toFixed(4)).join('\t'))
    copyText([figure.title, ...lines, ...corners].join('\n')).then(
      () => this.desk.say('The figures are in the clipboard.'),
      (error) => this.desk.complain(error),
    )
  }
}

/** Figures of a line through points with heights: distances between the first and the last, and along it. */
export function spaceFigures(points: readonly (readonly [number, number, number])[]): [string, string][] {
  const [first, last] = [points[0]!, points.at(-1)!]
  let along = 0
  for (let index = 1; index < points.length; index++) along += Math.hypot(...[0, 1, 2].map((axis) => points[index]![axis]! - points[index - 1]![axis]!))
  const level = Math.hypot(last[0] - first[0], last[1] - first[1])
  const rise = last[2] - first[2]
  const lines: [string, string][] = [
    ['Distance', format.metres(Math.hypot(level, rise), 4)],
    ['Horizontal', format.metres(level, 4)],
    ['Height difference', format.metres(rise, 4)],
    ['Slope', level > 0 ? `${format.fixed((100 * rise) / level, 2)}\u202f%` : '–'],
  ]
  if (points.length > 2) lines.unshift(['Along the line', format.metres(along, 4)])
  return lines
}
