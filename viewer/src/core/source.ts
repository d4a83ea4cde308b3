/** Where the page's files come from: the folder that it lies in, or itself (`single.html`). */

export interface Source {
  /** True where every file lies in the page itself. */
  readonly single: boolean
  json<T>(path: string): Promise<T>
  /** The bytes [begin, end) of a file, or all of it. */
  bytes(path: string, begin?: number, end?: number): Promise<Uint8Array<ArrayBuffer>>
  blob(path: string, type: string): Promise<Blob>
}

export class MissingFile extends Error {}

class HostedSource implements Source {
  readonly single = false
  readonly #whole = new Map<string, Promise<Uint8Array<ArrayBuffer>>>()

  async json<T>(path: string): Promise<T> {
    const answer = await this.#get(path)
    return (await answer.json()) as T
  }

  async bytes(path: string, begin?: number, end?: number): Promise<Uint8Array<ArrayBuffer>> {
    if (begin === undefined || end === undefined) return new Uint8Array(await (await this.#get(path)).arrayBuffer())
    const whole = this.#whole.get(path)
    if (whole) return (await whole).subarray(begin, end)
    const answer = await this.#get(path, { Range: `bytes=${begin}-${end - 1}` })
    const content = answer.arrayBuffer().then((buffer) => new Uint8Array(buffer))
    if (answer.status === 206) return content
    // A host that knows no ranges sends all of it: that is kept, so that it is sent once.
    this.#whole.set(path, content)
    return (await content).subarray(begin, end)
  }

  async blob(path: string, type: string): Promise<Blob> {
    const blob = await (await this.#get(path)).blob()
    return blob.type === type ? blob : new Blob([blob], { type })
  }

  async #get(path: string, headers: Record<string, string> = {}): Promise<Response> {
    const url = new URL(path, document.baseURI)
    if (url.origin !== location.origin) throw new MissingFile(`${path} lies on another host`)
    let answer: Response
    try {
      answer = await fetch(url, { headers })
    } catch {
      throw new MissingFile(`${path} could not be fetched: the host does not answer`)
    }
    if (!answer.ok) throw new MissingFile(`${path} could not be fetched: the host answered ${answer.status}`)
    return answer
  }
}

class EmbeddedSource implements Source {
  readonly single = true
  readonly #elements = new Map<string, HTMLScriptElement>()
  readonly #decoded = new Map<string, Uint8Array<ArrayBuffer>>()

  constructor(elements: Iterable<HTMLScriptElement>) {
    for (const element of elements) this.#elements.set(element.dataset['path'] ?? '', element)
  }

  async json<T>(path: string): Promise<T> {
    return JSON.parse(this.#element(path).textContent ?? '') as T
  }

  async bytes(path: string, begin?: number, end?: number): Promise<Uint8Array<ArrayBuffer>> {
    let content = this.#decoded.get(path)
    if (!content) {
      const element = this.#element(path)
      content = fromBase64(element.textContent ?? '')
      if (begin !== undefined) {
        this.#decoded.set(path, content)
        element.textContent = ''
      }
    }
    return begin === undefined ? content : content.subarray(begin, end)
  }

  async blob(path: string, type: string): Promise<Blob> {
    return new Blob([await this.bytes(path)], { type })
  }

  #element(path: string): HTMLScriptElement {
    const element = this.#elements.get(path)
    if (!element) throw new MissingFile(`${path} is not part of this page`)
    return element
  }
}

function fromBase64(text: string): Uint8Array<ArrayBuffer> {
  const binary = atob(text.trim())
  const bytes = new Uint8Array(binary.length)
  for (let index = 0; index < binary.length; index++) bytes[index] = binary.charCodeAt(index)
  return bytes
}

/** The page's own files where it holds any, else those beside it. */
export function findSource(): Source {
  const elements = document.querySelectorAll<HTMLScriptElement>('script[data-path]')
  return elements.length ? new EmbeddedSource(elements) : new HostedSource()
}
