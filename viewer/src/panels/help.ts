/** Keys and gestures. */

import { h } from '../core/dom'

const KEYS: [string, string][] = [
  ['M  C  P  S', 'Map, point cloud, pictures, strips'],
  ['/', 'Go to a name, an id, a kind, a place, a row or a station'],
  ['L', 'Layers (on small screens)'],
  ['Tab', 'From part to part; the map and the cloud take keys when they have the focus'],
  ['Arrows', 'Move the map or the cloud; in the strips, step along the road, with Shift by ten metres'],
  ['+  −  0', 'Nearer, farther, all of it'],
  ['Shift + arrows', 'Turn the cloud'],
  ['T', 'Look straight down on the cloud'],
  ['Enter', 'Choose what lies in the middle of the map or the cloud; while measuring, take it as a corner, and twice to end'],
  ['Esc', 'Give up a measurement; forget what is chosen'],
]

const MOUSE: [string, string][] = [
  ['Drag', 'Map: move. Cloud: turn about the place below the pointer'],
  ['Right or Shift drag', 'Cloud: move'],
  ['Wheel', 'Nearer or farther at the place below the pointer'],
  ['Double click', 'End a line that is measured, on the map, in the cloud or in a picture (by keys: Enter, with Shift to end)'],
]

export function helpDialog(): HTMLDialogElement {
  const list = (rows: [string, string][]): HTMLElement =>
    h('dl', { class: 'keys' }, ...rows.map(([key, text]) => h('div', {}, h('dt', {}, ...key.split('  ').map((one) => h('kbd', {}, one))), h('dd', {}, text))))
  const dialog: HTMLDialogElement = h(
    'dialog',
    { class: 'help', 'aria-labelledby': 'help-title' },
    h('h2', { id: 'help-title' }, 'Keys and gestures'),
    list(KEYS),
    list(MOUSE),
    h('p', {}, 'All coordinates are those of the survey, in metres. Distances on the map are those of its plane, without a reduction to the ground or the ellipsoid.'),
    h('form', { method: 'dialog' }, h('button', {}, 'Close')),
  )
  return dialog
}
