/** Two workers that decode nodes, so that the page stays quick. */

import code from 'worker:./decode.worker.ts'
import type { Decoded, DecodeTask } from './decode.worker'

const WORKERS = Math.max(1, Math.min(3, (navigator.hardwareConcurrency || 2) - 1))

interface Waiting {
  resolve: (decoded: Decoded) => void
  reject: (error: Error) => void
}

export class Decoders {
  readonly #workers: { worker: Worker; busy: number }[] = []
  readonly #waiting = new Map<number, Waiting & { of: { busy: number } }>()
  #next = 0

  decode(task: Omit<DecodeTask, 'id'>): Promise<Decoded> {
    const chosen = this.#choose()
    const id = this.#next++
    chosen.busy++
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject, of: chosen })
      chosen.worker.postMessage({ ...task, id })
    })
  }

  #choose(): { worker: Worker; busy: number } {
    const idle = this.#workers.find((one) => one.busy === 0)
    if (idle) return idle
    if (this.#workers.length < WORKERS) return this.#start()
    return this.#workers.reduce((least, one) => (one.busy < least.busy ? one : least))
  }

  #start(): { worker: Worker; busy: number } {
    const url = URL.createObjectURL(new Blob([code], { type: 'text/javascript' }))
    const started = { worker: new Worker(url), busy: 0 }
    started.worker.onmessage = ({ data }) => this.#answer(data)
    started.worker.onerror = (event) => {
      for (const [id, { of }] of this.#waiting) if (of === started) this.#answer({ id, wrong: event.message || 'the worker did not start' })
    }
    this.#workers.push(started)
    return started
  }

  #answer({ id, decoded, wrong }: { id: number; decoded?: Decoded; wrong?: string }): void {
    const waiting = this.#waiting.get(id)
    if (!waiting) return
    this.#waiting.delete(id)
    waiting.of.busy--
    if (decoded) waiting.resolve(decoded)
    else waiting.reject(new Error(wrong))
  }
}
