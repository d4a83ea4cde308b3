import { App } from './app'
import { fill, h } from './core/dom'
import { Desk } from './core/desk'
import type { Survey } from './core/site'
import { findSource } from './core/source'
import 'ol/ol.css'
import 'uplot/dist/uPlot.min.css'
import './style.css'

const LAYOUT = 1

async function start(): Promise<void> {
  const root = document.getElementById('app')!
  try {
    const source = findSource()
    const survey = await source.json<Survey>('survey.json')
    if (survey.layout !== LAYOUT) {
      throw new Error(`survey.json has the layout ${survey.layout}, and this page reads layout ${LAYOUT}: publish the survey again with the roadscan that this page is from`)
    }
    if (!survey.extent_m) throw new Error('nothing of this survey can be shown yet: run it first (roadscan run)')
    const app = new App(new Desk(survey, source))
    fill(root, app.element)
    app.begin()
  } catch (error) {
    const reason = error instanceof Error ? error.message : String(error)
    const hint = location.protocol === 'file:' ? 'A page that is opened as a file cannot read the files beside it: open it by a web server (roadscan view), or publish with --single.' : ''
    fill(root, h('div', { class: 'failure', role: 'alert' }, h('h1', {}, 'The survey could not be opened'), h('p', {}, reason), hint && h('p', {}, hint)))
  }
}

void start()
